"""What the twins of Gymnasium's MuJoCo tasks share."""

import abc
import dataclasses
import functools
import importlib.util
from pathlib import Path
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from sb3_hds.core import Channel, State
from sb3_hds.core.types import Action, Flag, Obs, Params, Position, Scalar
from sb3_hds.errors import EnvironmentMismatchError, ModelFileError
from sb3_hds.twins.mujoco.engine.twin import EngineTwin, Source
from sb3_hds.twins.mujoco.engine.values import Values
from sb3_hds.twins.mujoco.library import mujoco
from sb3_hds.twins.mujoco.rigid_body.quaternions import normalized

# Fields of a model that do not change its motion, or follow from others.
_SEEN = ("cam_", "light_", "tex_", "mat_", "name", "skin_", "geom_rgba", "site_rgba", "key_", "D_")
_DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0", "dof_M0", "actuator_acc0")
# [m], where the derivative of a distance ends.
_LEAST = 1e-5
# Width of the soft limits of the height of a planar walker [m].
_HEIGHT = 0.05
_OPTIONS = ("integrator", "cone", "solver", "iterations", "density", "viscosity", "disableflags")


class MujocoTask(EngineTwin):
    """
    Abstract: a task of Gymnasium, in its ``v5``. Options have the names and the defaults of the
    environment's arguments.
    """

    #: leading positions that the observation excludes by default, because nothing depends on them
    n_excluded: ClassVar[int] = 1
    #: velocities in the observation are clipped to plus and minus this
    max_speed: ClassVar[float] = float("inf")
    #: whether initial velocities are normal instead of uniform
    normal_speeds: ClassVar[bool] = False
    #: of all entries of a position
    positions: ClassVar[tuple[Channel, ...]]
    xml_file: str
    reset_noise_scale: float
    exclude_current_positions_from_observation: bool

    def __init__(self, **settings: Any) -> None:
        # Plain data may have lists in place of tuples.
        for name, value in settings.items():
            settings[name] = tuple(value) if isinstance(value, list) else value
        super().__init__(**settings)
        self.channels = self._channels()

    def _channels(self) -> tuple[Channel, ...]:
        speeds = (Channel(f"{joint.name}_velocity", f"{joint.unit}/s") for joint in self.joints)
        return (*self.positions[self._first :], *speeds)

    @property
    def _first(self) -> int:
        """Index of the first position in the observation."""
        return self.n_excluded * bool(self.exclude_current_positions_from_observation)

    def source(self) -> Source:
        return Asset(self.xml_file)

    @classmethod
    def from_env(cls, env: Any) -> Self:
        """:raises EnvironmentMismatchError: if the model is another one than its parameters say"""
        bare = env.unwrapped
        options = {name: getattr(bare, f"_{name}") for name in cls.options if name != "xml_file"}
        own = Path(bare.fullpath)
        usual = _path(cls.options["xml_file"])
        options["xml_file"] = cls.options["xml_file"] if own == usual else str(own)
        twin = cls(dt=float(bare.dt), substeps=int(bare.frame_skip), **options)
        try:
            values = Values(twin.model, twin.parameters)
        except ModelFileError as error:
            raise EnvironmentMismatchError(
                f"The twin {cls.name} expects another XML: {error}"
            ) from None
        twin = twin.with_parameters(**values.read(bare.model))
        made = values.model(np.array(list(twin.values.values())), bare.model.opt.timestep)
        if different := differences(made, bare.model):
            raise EnvironmentMismatchError(
                f"The model of the environment differs from {own.name} in {', '.join(different)}, "
                f"which are no parameters of the twin {cls.name}. Write them into an XML and pass "
                "it as xml_file, to the environment too."
            )
        return twin

    def initial(self, key: PRNGKeyArray, params: Params) -> State:
        """
        Uniform positions around the reference within ``reset_noise_scale``; orientations are
        normalised, as the first step does. Velocities alike, or normal.
        """
        noise, (k_q, k_v) = self.reset_noise_scale, jax.random.split(key)
        n_q, n_v = len(self.positions), len(self.joints)
        reference = jnp.asarray(self.model.qpos0) + jnp.zeros(n_q)
        q = reference + jax.random.uniform(k_q, (n_q,), minval=-noise, maxval=noise)
        if self.normal_speeds:
            v = noise * jax.random.normal(k_v, (n_v,))
        else:
            v = jax.random.uniform(k_v, (n_v,), minval=-noise, maxval=noise)
        return self.at(self._normalised(q), v.astype(q.dtype))

    def at(self, q: Position, v: Array) -> State:
        """:return: a state that was not simulated, with the readings that it determines"""
        return State(q, v, {})

    def infer(self, obs: Obs, params: Params) -> State:
        """Positions that the observation excludes are zero."""
        n = len(self.positions)
        q = jnp.concatenate([jnp.zeros(self._first, obs.dtype), obs[: n - self._first]])
        return self.at(q, obs[n - self._first : n - self._first + len(self.joints)])

    def observe(self, state: State, params: Params) -> Obs:
        speeds = jnp.clip(state.v, -self.max_speed, self.max_speed)
        return jnp.concatenate([state.q[self._first :], speeds])

    def _normalised(self, q: Position) -> Position:
        if len(self.positions) == len(self.joints):
            return q
        return jnp.concatenate([q[:3], normalized(q[3:7]), q[7:]])


class ForwardTask(MujocoTask):
    """Abstract: speed along x is rewarded, and effort costs."""

    forward_reward_weight: float
    ctrl_cost_weight: float

    def reward(self, state: State, action: Action, next_state: State, params: Params) -> Scalar:
        speed = (next_state.q[0] - state.q[0]) / self.dt
        return self.forward_reward_weight * speed - self.ctrl_cost_weight * jnp.sum(action**2)


class HealthyTask(ForwardTask):
    """
    Abstract: so is every step after which the robot is healthy; otherwise, the episode ends.

    Planning replaces the indicator by :meth:`health`.
    """

    healthy_reward: float
    terminate_when_unhealthy: bool

    @abc.abstractmethod
    def healthy(self, state: State) -> Flag:
        """:return: whether the robot stands"""

    @abc.abstractmethod
    def health(self, state: State) -> Scalar:
        """:return: smoothly from 0 to 1 where the robot is healthy, 1/2 at its limits"""

    def moving(self, state: State, action: Action, next_state: State, params: Params) -> Scalar:
        """:return: the reward without that of being healthy"""
        return ForwardTask.reward(self, state, action, next_state, params)

    def reward(self, state: State, action: Action, next_state: State, params: Params) -> Scalar:
        alive = self.healthy_reward * self.healthy(next_state)
        return self.moving(state, action, next_state, params) + alive

    def planning_reward(
        self, state: State, action: Action, next_state: State, params: Params
    ) -> Scalar:
        alive = self.healthy_reward * self.health(next_state)
        return self.moving(state, action, next_state, params) + alive

    def terminated(self, state: State, params: Params) -> Flag:
        return ~self.healthy(state) & bool(self.terminate_when_unhealthy)


class PlanarWalker(HealthyTask):
    """
    Abstract: legs under a torso, in the plane; healthy while the torso is high and upright enough.

    The observation clips velocities to 10, so :meth:`infer` does not recover faster ones. Planning
    replaces the indicator by a product of logistic functions of height and angle, 1/2 at the
    limits.
    """

    dt = 0.008
    substeps = 4
    max_episode_steps = 1000
    max_speed = 10.0
    #: width of the soft limits of the angle [rad]
    angle_width: ClassVar[float]
    healthy_z_range: tuple[float, float]
    healthy_angle_range: tuple[float, float]

    def healthy(self, state: State) -> Flag:
        height = inside(state.q[1], *self.healthy_z_range)
        return height & inside(state.q[2], *self.healthy_angle_range)

    def health(self, state: State) -> Scalar:
        height = margin(state.q[1], *self.healthy_z_range, _HEIGHT)
        return height * margin(state.q[2], *self.healthy_angle_range, self.angle_width)


@dataclasses.dataclass(frozen=True)
class Asset(Source):
    """
    A model file.

    :param xml_file: name of a file that Gymnasium ships, or a path
    """

    xml_file: str

    def load(self) -> Any:
        path = _path(self.xml_file)
        if not path.is_file():
            raise ModelFileError(
                f"There is no file '{path}'. xml_file is a path, or the name of a model that "
                "Gymnasium ships."
            )
        return mujoco().MjModel.from_xml_path(str(path))


@functools.cache
def _path(xml_file: str) -> Path:
    if xml_file.startswith((".", "/", "~")):
        return Path(xml_file).expanduser()
    found = importlib.util.find_spec("gymnasium")
    assert found is not None and found.origin is not None
    return Path(found.origin).parent / "envs" / "mujoco" / "assets" / xml_file


def differences(made: Any, other: Any) -> list[str]:
    """:return: names of the fields in which two models of MuJoCo move differently"""
    found = []
    for name in dir(made):
        if name.startswith(("_", *_SEEN)) or name in _DERIVED:
            continue
        ours, theirs = getattr(made, name), getattr(other, name)
        numbers = isinstance(ours, np.ndarray) and ours.dtype.kind in "fiub"
        if numbers and not (ours.shape == theirs.shape and np.allclose(ours, theirs, 1e-9, 1e-12)):
            found.append(name)
    found += [n for n in _OPTIONS if getattr(made.opt, n) != getattr(other.opt, n)]
    return found


def seen(read: Float[Array, "..."], own: Float[Array, "..."]) -> Float[Array, "..."]:
    """
    :param read: a reading of the engine
    :param own: the same quantity computed from the state, which the engine read a step earlier
    :return: the value of the reading with the derivative of the other
    """
    return own + jax.lax.stop_gradient(read - own)


def distance(way: Float[Array, " n"]) -> Scalar:
    """:return: the length of a vector, with a finite derivative where it is zero"""
    squared = jnp.sum(way**2)
    return seen(jnp.sqrt(squared), jnp.sqrt(squared + _LEAST**2))


def inside(x: Float[Array, "..."], low: float, high: float) -> Bool[Array, "..."]:
    return (x > low) & (x < high)


def margin(x: Scalar, low: float, high: float, width: float) -> Scalar:
    """:return: smoothly from 0 outside a range to 1 inside, 1/2 at its ends"""
    return jax.nn.sigmoid((x - low) / width) * jax.nn.sigmoid((high - x) / width)
