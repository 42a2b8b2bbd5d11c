"""Physical parameters of a compiled model of MuJoCo, by name."""

import copy
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from sb3_hds.core import Actuator, Joint, Parameter
from sb3_hds.errors import ModelFileError
from sb3_hds.twins.mujoco.library import mujoco

_OF_ITSELF = 0.1  # typical deviation, as a share of the value
_LEAST_DAMPING = 0.1  # typical deviation of the damping of a joint without any [N m s/rad]
_LEAST_MASS = 0.1  # as a share of the value: below, contacts and joint limits are too stiff

GRAVITY = "gravity"
FRICTION = "friction"


def declared(
    masses: Mapping[str, float] = {},
    damping: Mapping[str, float] = {},
    motors: Iterable[str] = (),
    gravity: float | None = 9.81,
    friction: bool = True,
    sliding: Iterable[str] = (),
) -> dict[str, Parameter]:
    """
    Declare parameters of a model.

    :param masses: by body [kg]; its inertia changes in proportion
    :param damping: by hinge or slide
    :param motors: actuators that have a gain, 1 for the model's own
    :param gravity: downwards [m/s2]; None where it has no effect
    :param friction: whether that of contacts has an effect
    :param sliding: joints of ``damping`` that are slides
    :return: ``<body>_mass``, ``<joint>_damping``, ``<actuator>_gain``, ``gravity`` and
        ``friction``, the factor on all coefficients of sliding friction
    """
    found = {}
    for body, mass in masses.items():
        found[f"{body}_mass"] = Parameter(mass, _OF_ITSELF * mass, "kg", _LEAST_MASS * mass)
    for joint, value in damping.items():
        unit = "N s/m" if joint in set(sliding) else "N m s/rad"
        scale = max(_OF_ITSELF * value, _LEAST_DAMPING)
        found[f"{joint}_damping"] = Parameter(value, scale, unit, 0.0)
    for motor in motors:
        found[f"{motor}_gain"] = Parameter(1.0, _OF_ITSELF, "1")
    if gravity is not None:
        found[GRAVITY] = Parameter(gravity, 0.5, "m/s2", min(gravity, 0.0))
    if friction:
        found[FRICTION] = Parameter(1.0, 0.2, "1", 0.0)
    return found


def natives(
    joints: Iterable[Joint], actuators: Iterable[Actuator], parameters: Mapping[str, Parameter]
) -> dict[tuple[str, int], dict[str, str]]:
    """:return: which effects are parameters of the model already, for ``Twin.native_effects``"""
    dampings = ((i, f"{joint.name}_damping") for i, joint in enumerate(joints))
    gains = ((i, f"{actuator.name}_gain") for i, actuator in enumerate(actuators))
    return {
        **{("viscous_friction", i): {"b": name} for i, name in dampings if name in parameters},
        **{("torque_gain", i): {"gain": name} for i, name in gains if name in parameters},
    }


class Values:
    """
    Reads and writes the values of parameters in models of one structure.

    :param nominal: a compiled model
    :param names: of parameters, as :func:`declared` makes them
    :raises ModelFileError: for the name of a body, joint or actuator that the model does not have
    """

    def __init__(self, nominal: Any, names: Iterable[str]) -> None:
        self.nominal, self.names = nominal, tuple(names)
        self._access = [_access(nominal, name) for name in self.names]

    def read(self, model: Any) -> dict[str, float]:
        """:return: the values of a model of the same structure"""
        return {n: float(get(model)) for n, (get, _) in zip(self.names, self._access, strict=True)}

    def model(self, values: np.ndarray, timestep: float | None = None) -> Any:
        """
        :param values: in the order of ``names``
        :param timestep: [s]; default: the nominal model's
        :return: a copy of the nominal model with these values
        """
        mj = mujoco()
        made = copy.copy(self.nominal)
        for (_, put), value in zip(self._access, values, strict=True):
            put(made, float(value))
        if timestep is not None:
            made.opt.timestep = timestep
        # Softness of contacts depends on masses.
        mj.mj_setConst(made, mj.MjData(made))
        return made


_Access = tuple[Callable[[Any], float], Callable[[Any, float], None]]


def _access(nominal: Any, name: str) -> _Access:
    """Functions that read and write one parameter."""
    if name == GRAVITY:
        return lambda m: -m.opt.gravity[2], _set_gravity
    if name == FRICTION:
        return _friction(nominal)
    where, _, kind = name.rpartition("_")
    if kind == "mass":
        return _mass(nominal, _index(nominal, "BODY", where))
    if kind == "damping":
        dof = int(nominal.jnt_dofadr[_index(nominal, "JOINT", where)])
        return lambda m: m.dof_damping[dof], lambda m, x: m.dof_damping.__setitem__(dof, x)
    if kind == "gain":
        return _gain(nominal, actuator_index(nominal, where))
    raise ModelFileError(f"A model has no parameter '{name}'.")


def _set_gravity(model: Any, value: float) -> None:
    model.opt.gravity[2] = -value


def _friction(nominal: Any) -> _Access:
    usual = nominal.geom_friction[:, 0].copy()
    largest = int(usual.argmax()) if len(usual) else 0

    def get(model: Any) -> float:
        return model.geom_friction[largest, 0] / usual[largest] if len(usual) else 1.0

    def put(model: Any, value: float) -> None:
        model.geom_friction[:, 0] = usual * value

    return get, put


def _mass(nominal: Any, body: int) -> _Access:
    mass, inertia = float(nominal.body_mass[body]), nominal.body_inertia[body].copy()

    def put(model: Any, value: float) -> None:
        model.body_mass[body] = value
        model.body_inertia[body] = inertia * (value / mass)

    return lambda model: model.body_mass[body], put


def _gain(nominal: Any, actuator: int) -> _Access:
    usual = float(nominal.actuator_gainprm[actuator, 0])

    def put(model: Any, value: float) -> None:
        model.actuator_gainprm[actuator, 0] = usual * value

    return lambda model: model.actuator_gainprm[actuator, 0] / usual, put


def actuator_name(model: Any, i: int) -> str:
    """:return: the name of an actuator; that of its joint if it has none"""
    mj = mujoco()
    own = mj.mj_id2name(model, mj.mjtObj.mjOBJ_ACTUATOR, i)
    joint = mj.mj_id2name(model, mj.mjtObj.mjOBJ_JOINT, int(model.actuator_trnid[i, 0]))
    return own or joint or f"actuator{i}"


def actuator_index(model: Any, name: str) -> int:
    """:raises ModelFileError: if there is none"""
    names = [actuator_name(model, i) for i in range(model.nu)]
    if name not in names:
        raise _unknown("actuator", name, names)
    return names.index(name)


def _index(model: Any, kind: str, name: str) -> int:
    mj = mujoco()
    found = mj.mj_name2id(model, getattr(mj.mjtObj, f"mjOBJ_{kind}"), name)
    if found < 0:
        count = {"BODY": model.nbody, "JOINT": model.njnt}[kind]
        named = [mj.mj_id2name(model, getattr(mj.mjtObj, f"mjOBJ_{kind}"), i) for i in range(count)]
        raise _unknown(kind.lower(), name, [one for one in named if one])
    return found


def _unknown(kind: str, name: str, known: Iterable[str]) -> ModelFileError:
    return ModelFileError(f"The model has no {kind} '{name}'. It has: {', '.join(known)}.")
