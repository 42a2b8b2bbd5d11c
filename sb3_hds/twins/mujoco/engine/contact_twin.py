"""A twin with contacts from a model file."""

import base64
import dataclasses
import zlib
from typing import Any

import numpy as np
from jaxtyping import Float

from sb3_hds.core import Actuator, Channel, Joint
from sb3_hds.errors import ModelFileError, ParameterError
from sb3_hds.twins.mujoco.engine.twin import EngineTwin, Source
from sb3_hds.twins.mujoco.engine.values import actuator_name, declared, natives
from sb3_hds.twins.mujoco.library import mujoco
from sb3_hds.twins.mujoco.model_twin import ModelTwin, Reward, Terminated


class ContactTwin(ModelTwin, EngineTwin):
    """
    A model of MuJoCo with contacts. Made by ``twins.from_mujoco(model, engine="mujoco")``.

    :param model: an ``MjModel``; or, from plain data, what :meth:`to_spec` made of one
    :param observe: ``"qv"`` for positions and velocities, ``"q"`` for positions only: then
        :meth:`infer` sets velocities to zero
    :param dt: control interval [s]; default: the model's time step
    :param substeps: default: as many as fit in ``dt`` with the model's time step
    :param reward: of a task; None: zero
    :param terminated: termination of a task; None: never
    :param settings: values of parameters
    :raises ModelFileError: for a model whose state is more than positions and velocities
    """

    name = "MuJoCoEngine"
    near_start = 0.05

    def __init__(
        self,
        model: Any = None,
        *,
        observe: str = "qv",
        dt: float | None = None,
        substeps: int | None = None,
        reward: Reward | None = None,
        terminated: Terminated | None = None,
        **settings: Any,
    ) -> None:
        if model is None:
            raise ParameterError(
                "A twin of this kind needs a model: twins.from_mujoco(path, engine='mujoco')."
            )
        self._source = Compiled.from_spec(model) if isinstance(model, str) else Compiled.of(model)
        self.set_task(observe, reward, terminated)
        read = self.model
        _check(read)
        mj = mujoco()
        joints = [_name(read, mj.mjtObj.mjOBJ_JOINT, j, "joint") for j in range(read.njnt)]
        simple, positions, dofs = [], [], []
        for j, name in enumerate(joints):
            kind = int(read.jnt_type[j])
            unit = "m" if kind == mj.mjtJoint.mjJNT_SLIDE else "rad"
            if kind in (mj.mjtJoint.mjJNT_SLIDE, mj.mjtJoint.mjJNT_HINGE):
                simple.append(name)
                dofs.append(Joint(name, unit))
                positions.append(Channel(f"{name}_position", unit))
                continue
            if kind == mj.mjtJoint.mjJNT_FREE:
                dofs += [Joint(f"{name}_{axis}", "m") for axis in "xyz"]
                positions += [Channel(f"{name}_{axis}", "m") for axis in "xyz"]
            dofs += [Joint(f"{name}_r{axis}") for axis in "xyz"]
            positions += [Channel(f"{name}_q{part}", "1") for part in "wxyz"]
        self.joints = tuple(dofs)
        speeds = [Channel(f"{joint.name}_velocity", f"{joint.unit}/s") for joint in dofs]
        self.channels = (*positions, *(speeds if observe == "qv" else ()))
        motors = [actuator_name(read, i) for i in range(read.nu)]
        limits = [_limits(read, i) for i in range(read.nu)]
        self.actuators = tuple(Actuator(n, "1", *b) for n, b in zip(motors, limits, strict=True))
        bodies = [_name(read, mj.mjtObj.mjOBJ_BODY, b, "") for b in range(read.nbody)]
        self.parameters = declared(
            masses={
                name: float(read.body_mass[b])
                for b, name in enumerate(bodies)
                if name and read.body_weldid[b] and read.body_mass[b] > 0.0
            },
            damping={
                name: float(read.dof_damping[read.jnt_dofadr[joints.index(name)]])
                for name in simple
                if mj.mj_name2id(read, mj.mjtObj.mjOBJ_JOINT, name) >= 0
            },
            motors=[n for n, gain in zip(motors, read.actuator_gainprm[:, 0], strict=True) if gain],
            gravity=float(-read.opt.gravity[2]),
            sliding=[joint.name for joint in dofs if joint.unit == "m"],
        )
        # The gain of a servo is no gain of its force.
        self.native_effects = natives(dofs, (), self.parameters)
        step = float(read.opt.timestep)
        dt = step if dt is None else dt
        if substeps is None:
            substeps = max(1, round(dt / step))
        super().__init__(dt=dt, substeps=substeps, **settings)

    def source(self) -> Source:
        return self._source

    @property
    def start(self) -> Float[np.ndarray, " n_q"]:
        return self.model.key_qpos[0] if self.model.nkey else self.model.qpos0

    def to_spec(self) -> dict[str, Any]:
        """
        Without reward and termination, which are functions. The model is in MuJoCo's binary format,
        which only the same version of MuJoCo reads.
        """
        options = {
            "model": self._source.to_spec(),
            "observe": self.observed,
            "dt": self.dt,
            "substeps": self.substeps,
        }
        return {"twin": self.name, "options": options, "parameters": dict(self.values)}


@dataclasses.dataclass(frozen=True)
class Compiled(Source):
    """
    A compiled model.

    :param content: in MuJoCo's binary format
    """

    content: bytes

    @classmethod
    def of(cls, model: Any) -> "Compiled":
        """:param model: an ``MjModel``"""
        mj = mujoco()
        content = np.empty(mj.mj_sizeModel(model), np.uint8)
        mj.mj_saveModel(model, None, content)
        return cls(content.tobytes())

    @classmethod
    def from_spec(cls, text: str) -> "Compiled":
        return cls(zlib.decompress(base64.b64decode(text)))

    def to_spec(self) -> str:
        return base64.b64encode(zlib.compress(self.content)).decode()

    def load(self) -> Any:
        read = mujoco().MjModel.from_binary_path
        try:
            return read("model.mjb", {"model.mjb": self.content})
        except ValueError as error:
            raise ModelFileError(
                f"MuJoCo does not read the saved model: {error}. Another version of MuJoCo may "
                "have written it; make the twin from its file again."
            ) from None


def _check(model: Any) -> None:
    for count, what in (
        (model.na, "actuators with a state (activation)"),
        (model.nplugin, "plugins"),
        (model.nmocap, "mocap bodies"),
        (model.nflex, "bodies that bend (flex)"),
    ):
        if count:
            raise ModelFileError(
                f"The model has {what}, so its state is more than positions and velocities, which "
                "is all that a twin carries on. Remove them from the model."
            )


def _name(model: Any, kind: Any, i: int, otherwise: str) -> str:
    return mujoco().mj_id2name(model, kind, i) or (f"{otherwise}{i}" if otherwise else "")


def _limits(model: Any, i: int) -> tuple[float, float]:
    if not model.actuator_ctrllimited[i]:
        return (-float("inf"), float("inf"))
    low, high = model.actuator_ctrlrange[i]
    return float(low), float(high)
