"""A twin made from a model file."""

import copy
import hashlib
import json
import math
from collections.abc import Collection, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sb3_hds.core import Actuator, AnalyticTwin, Channel, Joint, State, rk4, semi_implicit_euler
from sb3_hds.core.types import Action, Force, MassMatrix, Params, Position, Velocity
from sb3_hds.errors import ParameterError
from sb3_hds.twins.mujoco.actuators import Actuation, Moving
from sb3_hds.twins.mujoco.equation import Equation
from sb3_hds.twins.mujoco.mechanism import FREE, SLIDE, Mechanism
from sb3_hds.twins.mujoco.model_twin import ModelTwin, Reward, Terminated
from sb3_hds.twins.mujoco.parameters import (
    dof_names,
    named_bodies,
    native_effects,
    of_drives,
    of_mass,
    place_of,
    shape_of,
)
from sb3_hds.twins.mujoco.rigid_body import algebra as alg
from sb3_hds.twins.mujoco.rigid_body.dynamics import frames_of

_UNLIMITED = (-math.inf, math.inf)


class MechanismTwin(ModelTwin, AnalyticTwin):
    r"""
    A tree of rigid bodies with hinges, slides, ball and free joints, as a model file describes it.

    .. math:: M(q)\,\dot v + c(q, v) + \tau_\text{damping} + \tau_\text{dry} + \tau_\text{spring}
              = \tau(q, v, u)

    Equals MuJoCo's ``Euler``, ``implicitfast`` and ``RK4`` without contacts, active joint limits
    and dry friction. Dry friction is :math:`\tau_c \tanh(v / 0.01)`, taken like damping at the end
    of the step (by ``RK4`` at its beginning, smoothed over the speed that a step can stop): under a
    load a joint creeps where MuJoCo's sticks.

    Made by ``twins.from_mujoco``.

    :param mechanism: the data of the model, also as plain data
    :param observe: ``"qv"`` for positions and velocities, ``"q"`` for positions only: then
        :meth:`infer` sets velocities to zero
    :param payload: name of the site or body that may carry an unknown mass
    :param masses: bodies whose mass, centre and inertia are parameters; True: all
    :param dt: control interval [s]; default: the model's time step
    :param substeps: default: the fewest with at most the model's time step
    :param reward: of a task; None: zero
    :param terminated: termination of a task; None: never
    :param settings: values of parameters
    """

    name = "MuJoCo"
    near_start = 0.1

    def __init__(
        self,
        mechanism: Mechanism | Mapping[str, Any] | None = None,
        *,
        observe: str = "qv",
        payload: str | None = None,
        masses: bool | Collection[str] = False,
        dt: float | None = None,
        substeps: int | None = None,
        reward: Reward | None = None,
        terminated: Terminated | None = None,
        **settings: Any,
    ) -> None:
        if mechanism is None:
            raise ParameterError(
                "A twin of this kind needs a model: twins.from_mujoco(path of an MJCF or URDF)."
            )
        if not isinstance(mechanism, Mechanism):
            mechanism = Mechanism.from_spec(mechanism)
        self.mechanism, self.name = mechanism, mechanism.name
        self.set_task(observe, reward, terminated)
        self.payload = None if payload is None else place_of(mechanism, payload)
        self._declare(named_bodies(mechanism, masses))
        self.actuation = Actuation(mechanism)
        self.native_effects = native_effects(mechanism)
        limits = [link.limit or _UNLIMITED for link in mechanism.links for _ in link.dofs]
        self.joints = tuple(
            Joint(*joint, *limit) for joint, limit in zip(dof_names(mechanism), limits, strict=True)
        )
        self.actuators = tuple(_actuators(mechanism))
        velocities = [Channel(f"{n}_velocity", f"{unit}/s") for n, unit in dof_names(mechanism)]
        self.channels = (*_positions(mechanism), *(velocities if observe == "qv" else ()))
        self.integrator = rk4 if mechanism.integrator == "rk4" else semi_implicit_euler
        self._digest = hashlib.sha1(json.dumps(mechanism.to_spec()).encode()).hexdigest()
        dt = mechanism.timestep if dt is None else dt
        if substeps is None and dt > 0.0:
            substeps = max(1, math.ceil(dt / mechanism.timestep - 1e-6))
        super().__init__(dt=dt, substeps=substeps, **settings)

    def _declare(self, masses: tuple[str, ...]) -> None:
        self.masses = masses
        self.equation = Equation(self.mechanism, self.payload, masses)
        self.parameters = self.equation.parameters | of_drives(self.mechanism)
        # The damping gain of a drive counts as known, because viscous friction is aliased with it;
        # so does the shape of a body, which hardly any motion identifies.
        servos = ("position", "velocity")
        damping = {f"{d.name}_kv" for d in self.mechanism.drives if d.role in servos}
        shapes = {name for body in masses for name in shape_of(body)}
        self.known_parameters = frozenset(damping | shapes)

    def freed(self, names: Collection[str] | None = None) -> "MechanismTwin":
        every = named_bodies(self.mechanism, True)
        wanted = [b for b in every if names is None or not {*of_mass(b)}.isdisjoint(names)]
        masses = tuple(body for body in every if body in {*self.masses, *wanted})
        if masses == self.masses:
            return self
        changed = copy.copy(self)
        changed._declare(masses)
        nominal = {name: parameter.null for name, parameter in changed.parameters.items()}
        changed.values = nominal | self.values
        return changed

    # --- dynamics

    def actuate(self, state: State, action: Action, params: Params) -> Force:
        return self.actuation.force(self._moving(state), action, params)

    def mass_matrix(self, q: Position, params: Params) -> MassMatrix:
        return self.equation.mass_matrix(q, params)

    def bias(self, q: Position, v: Velocity, params: Params) -> Force:
        return self.equation.bias(q, v, params, self._explicit_step)

    def accelerate(self, state: State, command: Action, added: Force, params: Params) -> Velocity:
        force = self.actuate(state, command, params) + added
        coupling = self._coupling(state, command, params)
        q, v, step = state.q, state.v, self._explicit_step
        return self.equation.acceleration(q, v, force, coupling, params, step)

    def _coupling(self, state: State, command: Action, params: Params) -> MassMatrix:
        """The step times derivatives by velocities, for forces taken at the end of the step."""
        mechanism, h = self.mechanism, self.dt / self.substeps
        implicit = mechanism.integrator == "implicitfast"
        slope = jnp.zeros_like(state.v)
        if not self._explicit_step:
            slope = h * self.equation.resistance(state.v, params, self._explicit_step)[1]
        found = jnp.diag(slope)
        if implicit and any(drive.follows_speed for drive in mechanism.drives):
            found = found - h * self.actuation.slope(self._moving(state), command, params)
        return found

    @property
    def _explicit_step(self) -> float:
        """The step [s] if damping is taken at its beginning, 0 if at its end."""
        euler = self.mechanism.integrator == "euler" and self.mechanism.implicit_damping
        implicit = euler or self.mechanism.integrator == "implicitfast"
        return 0.0 if implicit else self.dt / self.substeps

    def _moving(self, state: State) -> Moving:
        return Moving(state.q, self.coordinates(state.q), state.v)

    def typical_forces(self) -> tuple[float, ...]:
        """Largest gravity at random positions, plus the limits of the actuators."""
        usual = self.equation.typical
        return tuple((usual.weight + usual.drive).tolist())

    # --- positions

    @property
    def quaternions(self) -> tuple[tuple[int, int], ...]:
        quaternions = [link.quaternion for link in self.mechanism.links if link.quaternion]
        return tuple((at.start, i) for i, at in enumerate(quaternions))

    @property
    def reference(self) -> Float[np.ndarray, " n_q"]:
        zero = np.zeros(self.mechanism.n_q)
        zero[[start for start, _ in self.quaternions]] = 1.0
        return zero

    @property
    def start(self) -> Float[np.ndarray, " n_q"]:
        return np.array(self.mechanism.start)

    def skeleton(self, state: State) -> Float[Array, "capsules 2 3"]:
        """
        :return: both ends of a capsule for each link: from its parent's frame to its own, and from
            the frame of a leaf to the farthest of its centre of mass, sites and bodies [m]
        """
        links, zero = self.mechanism.links, jnp.zeros_like(state.v[0])
        frames = frames_of(links, list(state.q))
        place = lambda point: jnp.stack([zero + x for x in point])  # noqa: E731
        found = []
        for i, link in enumerate(links):
            if link.parent >= 0:
                found.append(jnp.stack([place(frames[link.parent][1]), place(frames[i][1])]))
            elif link.kind != FREE:
                found.append(jnp.stack([place(alg.ZERO), place(frames[i][1])]))
            if any(other.parent == i for other in links):
                continue
            here = [p.position for p in self.mechanism.places if p.link == i]
            ends = here + ([link.body.centre] if link.body else [])
            tip = max(ends, key=lambda end: sum(x * x for x in end), default=alg.ZERO)
            rotation, origin = frames[i]
            outwards = alg.vadd(origin, alg.apply(rotation, tip))
            found.append(jnp.stack([place(origin), place(outwards)]))
        return jnp.stack(found)

    def meshes(self, state: State) -> Float[Array, "shapes corners 3"]:
        """
        :return: corners of the convex hulls of the model's meshes [m]; those of smaller hulls are
            repeated
        """
        shapes, frames = self.mechanism.shapes, frames_of(self.mechanism.links, list(state.q))
        most = max((len(shape.points) for shape in shapes), default=0)
        zero, found = jnp.zeros_like(state.q[0]), [jnp.zeros((0, most, 3), state.q.dtype)]
        for shape in shapes:
            points = jnp.asarray(np.resize(np.array(shape.points), (most, 3)), state.q.dtype)
            if shape.link >= 0:
                rows, origin = frames[shape.link]
                rotation = jnp.stack([jnp.stack([zero + x for x in row]) for row in rows])
                points = points @ rotation.T + jnp.stack([zero + x for x in origin])
            found.append(points[None])
        return jnp.concatenate(found)

    def sketch(self, state: State, params: Params) -> Float[Array, "points 2"]:
        """The mechanism seen along y: from the world through all joints to each leaf."""
        links, zero = self.mechanism.links, jnp.zeros_like(state.v[0])
        frames = frames_of(links, list(state.q))
        seen = lambda place: jnp.stack([zero + place[0], zero + place[2]])  # noqa: E731
        places = [seen(origin) for _, origin in frames]
        points = [jnp.stack([zero, zero])]
        for i, link in enumerate(links):
            if any(other.parent == i for other in links):
                continue
            chain = [i]
            while links[chain[-1]].parent >= 0:
                chain.append(links[chain[-1]].parent)
            rotation, origin = frames[i]
            tip = alg.vadd(origin, alg.apply(rotation, link.body.centre if link.body else alg.ZERO))
            outwards = [*(places[j] for j in reversed(chain)), seen(tip)]
            points += [*outwards, *reversed(outwards[:-1]), points[0]]
        return jnp.stack(points)

    # --- plain data

    def to_spec(self) -> dict[str, Any]:
        """Without reward and termination, which are functions."""
        options = {
            "mechanism": self.mechanism.to_spec(),
            "observe": self.observed,
            "payload": self.payload and self.payload.name,
            "masses": self.masses,
            "dt": self.dt,
            "substeps": self.substeps,
        }
        return {"twin": "MuJoCo", "options": options, "parameters": dict(self.values)}

    def structure(self) -> tuple[Any, ...]:
        return (*super().structure(), self._digest, self.payload, self.masses)


def _actuators(mechanism: Mechanism) -> list[Actuator]:
    found = []
    for drive in mechanism.drives:
        straight = mechanism.links[drive.link].kind == SLIDE
        for name, limits in zip(drive.inputs, drive.ranges, strict=True):
            low, high = limits or (-math.inf, math.inf)
            full = f"{drive.name}_{name}" if len(drive.inputs) > 1 else drive.name
            found.append(Actuator(full, _unit_of(drive, name, straight), low, high))
    return found


def _unit_of(drive: Any, name: str, straight: bool) -> str:
    force, length = ("N", "m") if straight else ("N m", "rad")
    geared = drive.gear != (1.0,)
    if drive.kind == "affine":
        name = {"position": "pos", "velocity": "vel"}.get(drive.role, "")
        if drive.role == "motor" and drive.gain[0] == 1.0 and not geared:
            return force
    units = {"pos": length, "vel": f"{length}/s", "ff": force, "voltage": "V"}
    return "1" if geared and name != "voltage" else units.get(name, "1")


def _positions(mechanism: Mechanism) -> list[Channel]:
    found = []
    for link in mechanism.links:
        if link.kind == FREE:
            found += [Channel(f"{link.joint}_{axis}", "m") for axis in "xyz"]
        if link.quaternion:
            found += [Channel(f"{link.joint}_q{part}", "1") for part in "wxyz"]
        else:
            found.append(Channel(f"{link.joint}_position", "m" if link.kind == SLIDE else "rad"))
    return found
