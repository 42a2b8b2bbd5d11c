"""Make a twin of a robot from its model file."""

import dataclasses
import math
import warnings
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from sb3_hds.errors import ParameterError, did_you_mean
from sb3_hds.twins.mujoco.engine.contact_twin import ContactTwin
from sb3_hds.twins.mujoco.files.load import load
from sb3_hds.twins.mujoco.files.locking import Lock, Locks, locked_positions
from sb3_hds.twins.mujoco.files.reading import integrator_of, read
from sb3_hds.twins.mujoco.files.refusals import refuse
from sb3_hds.twins.mujoco.files.shapes import shapes_of
from sb3_hds.twins.mujoco.identifiability import unidentifiable
from sb3_hds.twins.mujoco.mechanism import Drive, Link, Mechanism
from sb3_hds.twins.mujoco.model_twin import Reward, Terminated
from sb3_hds.twins.mujoco.twin import MechanismTwin

_KINDS = ("torque", "position", "velocity")


def from_mujoco(
    model_or_path_or_env: Any,
    *,
    engine: str = "auto",
    actuators: str | Mapping[str, Any] | None = None,
    dt: float | None = None,
    integrator: str | None = None,
    observe: str = "qv",
    payload: str | None = None,
    masses: bool | Collection[str] = False,
    reward: Reward | None = None,
    terminated: Terminated | None = None,
    ignore: Collection[str] = (),
    lock: Lock = (),
) -> MechanismTwin | ContactTwin:
    """
    A twin of a model that MuJoCo can load: in JAX, without contacts, or on MuJoCo's own engine.

    Parameters have the names of the file: ``elbow_damping``, ``elbow_frictionloss``,
    ``elbow_armature``, ``elbow_servo_kp``.

    :param model_or_path_or_env: path or text of an MJCF or URDF file (meshes may be missing where
        inertials are given), an ``MjSpec`` or ``MjModel``, or a MuJoCo environment of Gymnasium
    :param engine: ``"smooth"``: rigid bodies without contacts in JAX, which everything of the
        package takes; ``"mujoco"``: MuJoCo's own engine with contacts, limits, tendons and
        equality constraints, for planning and learning; ``"auto"``: the same as ``"smooth"``
    :param actuators: for a model without actuators, or to replace them: ``"torque"`` (default for a
        URDF) for a motor at each hinge and slide, within its effort limit; or a mapping such as
        ``{"kind": "position", "kp": 20.0, "kv": 1.5}``, whose commands are targets. A value is one
        number, or a mapping from joints to numbers; ``limit`` is that of the force.
    :param dt: control interval [s]; default: the environment's, or the model's time step
    :param integrator: ``"euler"``, ``"implicitfast"`` or ``"rk4"``; default: the model's, or
        ``"implicitfast"`` for a URDF
    :param observe: ``"qv"`` for positions and velocities, ``"q"`` for positions only
    :param payload: name of a site or body at which, or near which, an unknown mass may be
    :param masses: names of bodies whose mass, centre and inertia are parameters, too, or True for
        all; a warning lists those that no motion can identify. A diagnosis tries masses and centres
        of all bodies anyway.
    :param reward: of a task: ``reward(state, action, next_state, params)``
    :param terminated: termination of a task: ``terminated(state, params)``
    :param ignore: features of the model that the twin omits: ``"contacts"`` if there are none in
        the data, ``"equality"``, ``"fluid"``, ``"limits"``, ``"tendons"``
    :param lock: joints that stand still, such as a gripper's: names or patterns, ``"*_finger_*"``,
        or a mapping of them to positions [rad] or [m]; default: the reference position. What they
        carry keeps its inertia and becomes rigid. Joints that follow a locked one are locked, too;
        actuators that drive only locked joints are left out
    :raises ModelFileError: for a file that cannot be read, or unsupported features of the model
    :raises ParameterError: for invalid actuators, integrator, payload or locked joints
    """
    if engine not in ("auto", "smooth", "mujoco"):
        raise ParameterError(f"engine must be 'smooth', 'mujoco' or 'auto', got {engine!r}.")
    loaded = load(model_or_path_or_env)
    if engine == "mujoco":
        if actuators is not None or integrator is not None or payload is not None or masses or lock:
            raise ParameterError(
                "actuators, integrator, payload, masses and lock are for engine='smooth'. Write "
                "them into the model; on MuJoCo's engine, masses are parameters anyway."
            )
        dt = loaded.dt if dt is None else dt
        task: Any = {"reward": reward, "terminated": terminated}
        return ContactTwin(loaded.model, observe=observe, dt=dt, **task)
    if integrator is None:
        integrator = "implicitfast" if loaded.urdf else integrator_of(loaded.model)
    ignore = (ignore,) if isinstance(ignore, str) else tuple(ignore)
    locks = Locks.of(loaded.model, locked_positions(loaded.model, lock, loaded.mimics))
    refuse(loaded.model, integrator, ignore, locks, loaded.mimics)
    mechanism = read(loaded.model, integrator=integrator, locks=locks)
    changes: dict[str, Any] = {}
    if loaded.drawn is not None:
        changes["shapes"] = shapes_of(loaded.drawn, mechanism.places)
    if "limits" in ignore:
        changes["links"] = tuple(dataclasses.replace(x, limit=None) for x in mechanism.links)
    if actuators is None and not mechanism.drives:
        actuators = "torque"
    if actuators is not None:
        changes["drives"] = tuple(_drives(mechanism, actuators))
    twin = MechanismTwin(
        dataclasses.replace(mechanism, **changes),
        observe=observe,
        payload=payload,
        masses=masses,
        dt=loaded.dt if dt is None else dt,
        reward=reward,
        terminated=terminated,
    )
    if masses and (words := unidentifiable(twin)):
        warnings.warn(words, stacklevel=2)
    return twin


def _drives(mechanism: Mechanism, wanted: str | Mapping[str, Any]) -> list[Drive]:
    """A drive at each hinge and slide."""
    given = {"kind": wanted} if isinstance(wanted, str) else dict(wanted)
    kind = str(given.pop("kind", None))
    gains = {"torque": (), "position": ("kp", "kv"), "velocity": ("kv",)}.get(kind)
    if gains is None:
        raise ParameterError(
            f"actuators is one of {', '.join(map(repr, _KINDS))}, alone or as the 'kind' of a "
            f"mapping such as {{'kind': 'position', 'kp': 20.0, 'kv': 1.5}}, got {wanted!r}."
        )
    unknown = [name for name in given if name not in (*gains, "limit")]
    missing = [name for name in gains[:1] if name not in given]
    if unknown or missing:
        raise ParameterError(
            f"actuators of kind '{kind}' take {', '.join((*gains, 'limit'))}"
            + (f", not {', '.join(unknown)}." if unknown else f"; {missing[0]} is missing.")
        )
    joints = [link for link in mechanism.links if not link.quaternion]
    values = {name: _by_joint(name, value, joints) for name, value in given.items()}
    index = {link.joint: i for i, link in enumerate(mechanism.links)}
    found = []
    for link in joints:
        kp, kv, limit = (values.get(name, {}).get(link.joint) for name in ("kp", "kv", "limit"))
        kp, kv = kp or 0.0, kv or 0.0
        force = None if limit is None else (-limit, limit)
        found.append(
            Drive(
                name=link.joint,
                kind="affine",
                link=index[link.joint],
                gear=(1.0,),
                outer=False,
                inputs=("",),
                ranges=((force or link.force_limit) if kind == "torque" else None,),
                gain=({"torque": 1.0, "position": kp, "velocity": kv}[kind], 0.0, 0.0),
                bias=(0.0, -kp, -kv),
                force_limit=force,
            )
        )
    return found


def _by_joint(name: str, value: Any, joints: Sequence[Link]) -> dict[str, float]:
    """One number for each joint, from a mapping or a common value."""
    known = [link.joint for link in joints]
    if not isinstance(value, Mapping):
        value = dict.fromkeys(known, value)
    unknown = [joint for joint in value if joint not in known]
    missing = [joint for joint in known if joint not in value]
    if unknown or missing:
        raise ParameterError(
            f"{name} of actuators is one number or a number for each joint: "
            + (
                f"there is no joint '{unknown[0]}'.{did_you_mean(unknown[0], known)}"
                if unknown
                else f"{', '.join(missing)} is missing."
            )
        )
    try:
        found = {joint: float(number) for joint, number in value.items()}
    except (TypeError, ValueError):
        raise ParameterError(f"{name} of actuators must be numbers, got {value!r}.") from None
    if not all(math.isfinite(number) and number >= 0.0 for number in found.values()):
        raise ParameterError(f"{name} of actuators must be finite and not below 0, got {found}.")
    return found
