"""A central pattern generator as a prior that a policy modulates."""

from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces

from sb3_hds.core import Rhythm
from sb3_hds.errors import EnvironmentMismatchError
from sb3_hds.wrappers.action_layer import TransformLayer, check_bounded
from sb3_hds.wrappers.actuated_joints import (
    COMMANDS_POSITIONS,
    ActuatedJoints,
    joints_of,
    refuse_servos,
)
from sb3_hds.wrappers.interval import interval_of


class CPGPrior(TransformLayer):
    r"""
    Oscillators move the joints, and the policy's action, from -1 to 1, adjusts them: an offset of
    their targets, a residual on the commands, or their amplitudes and frequency. See
    :class:`~sb3_hds.core.Rhythm` for the equations.

    Sine and cosine of the common phase are appended to the observation, and in the third mode the
    amplitudes and their rates, so that the task stays Markov.

    A PD controller tracks the targets if joint states are known: from the entries ``position`` and
    ``velocity`` of the observation, or else, in MuJoCo environments, from the simulator. Otherwise,
    with ``control="direct"``, and where commands are positions (MuJoCo's position servos, or an
    environment whose attribute ``commands_positions`` is true), targets are the commands. Commands
    are clipped to the action space below. The wrapper has a twin counterpart unless joints are read
    from MuJoCo, whose state a twin does not have: name their entries.

    ``info["command"]`` is the command of the environment below, ``info["target"]`` the target of
    the joints. Learners store the raw action, because a command has no unique action.

    In the zoo's yml: ``env_wrapper: [{sb3_hds.wrappers.CPGPrior: {omega_swing: 3.9, ...}}]``.
    :meth:`sb3_hds.OpenLoop.constants` returns the gait that a search found as these arguments.

    Source: Bellegarda and Ijspeert, *CPG-RL*, RA-L 2022, for parameters; Raffin et al., *Learning
    to exploit elastic actuators for quadruped locomotion*, 2022, for offsets.

    :param env: with a bounded Box of one axis as action space
    :param mode: ``"offset"``, ``"residual"`` or ``"parameters"``
    :param omega_swing: [rad/s]
    :param omega_stance: [rad/s]; None: as ``omega_swing``
    :param amplitude: one per actuator, or one for all [rad]
    :param offset: one per actuator, or one for all [rad]
    :param phase: one per actuator, or one for all [rad]
    :param kp: [command unit / rad]
    :param kd: [command unit s / rad]
    :param action_range: range of the offset [rad], or of the residual [command units]
    :param amplitude_factor: smallest and largest, for ``"parameters"``
    :param frequency_factor: smallest and largest, for ``"parameters"``
    :param amplitude_gain: convergence rate of the amplitudes [1/s]
    :param control: ``"track"``, ``"direct"``, or ``"auto"``
    :param position: index in the observation of each actuator's joint position
    :param velocity: index of its velocity
    :param dt: control interval [s]; default: the environment's own
    :param observe_state: whether the phase and the amplitudes are appended; without them, the task
        is not Markov
    :param store: ``"raw"``
    :raises EnvironmentMismatchError: for an environment without the joints to track
    :raises ParameterError: for arguments out of range, or not one per actuator
    """

    stores: ClassVar[tuple[str, ...]] = ("raw",)

    def __init__(
        self,
        env: gymnasium.Env,
        *,
        mode: str = "offset",
        omega_swing: float,
        omega_stance: float | None = None,
        amplitude: float | Sequence[float] = 1.0,
        offset: float | Sequence[float] = 0.0,
        phase: float | Sequence[float] = 0.0,
        kp: float | Sequence[float] = 1.0,
        kd: float | Sequence[float] = 0.05,
        action_range: float | Sequence[float] = 0.1,
        amplitude_factor: Sequence[float] = (0.0, 2.0),
        frequency_factor: Sequence[float] = (0.5, 2.0),
        amplitude_gain: float = 50.0,
        control: str = "auto",
        position: Sequence[int] = (),
        velocity: Sequence[int] = (),
        dt: float | None = None,
        observe_state: bool = True,
        store: str = "raw",
    ) -> None:
        passed_on = {
            "mode": mode,
            "amplitude": amplitude,
            "offset": offset,
            "phase": phase,
            "kp": kp,
            "kd": kd,
            "action_range": action_range,
            "amplitude_factor": amplitude_factor,
            "frequency_factor": frequency_factor,
            "amplitude_gain": amplitude_gain,
            "position": position,
            "velocity": velocity,
        }
        check_bounded(type(self), env.action_space)
        n = spaces.flatdim(env.action_space)
        self._joints = _tracked(env, control, n, bool(position))
        rhythm = Rhythm(
            omega_swing=omega_swing,
            omega_stance=omega_swing if omega_stance is None else omega_stance,
            dt=interval_of(env, EnvironmentMismatchError, from_fps=True)
            if dt is None
            else float(dt),
            observed=observe_state,
            **passed_on,
        )
        self.rhythm = rhythm.sized(n)
        super().__init__(
            env,
            self.rhythm,
            store,
            omega_swing=omega_swing,
            omega_stance=omega_stance,
            control=control,
            dt=dt,
            observe_state=observe_state,
            **passed_on,
        )
        self.action_space = spaces.Box(-1.0, 1.0, (self.rhythm.n_actions,), np.float32)
        self._target = self._command = np.zeros(n)

    @property
    def twin_transform(self) -> Rhythm | None:
        """None where joints are read from MuJoCo."""
        return self.rhythm if self._joints is None else None

    def decide(self, action: np.ndarray) -> np.ndarray:
        rhythm, chosen = self.rhythm, np.clip(action, -1.0, 1.0)
        self._target, self._memory = rhythm.target(chosen, self._memory)
        self._command = rhythm.command(chosen, self._target, *self._readings())
        return self._command

    def nominal(self, action: np.ndarray) -> np.ndarray:
        return self._rounded(self._command)

    def extra_info(self) -> dict[str, Any]:
        return {"command": self._rounded(self._command), "target": self._target}

    def _readings(self) -> tuple[np.ndarray | None, np.ndarray | None]:
        if self._joints is None:
            return self.rhythm.joints_in(self._obs)
        inner: Any = self.env.unwrapped
        return self._joints.of_state(inner.state_vector())


def _tracked(env: gymnasium.Env, control: str, n: int, named: bool) -> ActuatedJoints | None:
    """:return: the joints to read from MuJoCo; None if there are none to read"""
    if control not in ("auto", "track", "direct"):
        raise EnvironmentMismatchError(
            f"CPGPrior(control={control!r}): control must be 'auto', 'track' or 'direct'."
        )
    if control == "direct" and named:
        raise EnvironmentMismatchError(
            "CPGPrior(control='direct') tracks no joints, so position and velocity must be empty."
        )
    if control == "direct" or named:
        return None
    found, inner = joints_of(env), env.unwrapped
    fits = found is not None and len(found.names) == n
    if fits:
        try:
            refuse_servos(inner.model, getattr(inner, COMMANDS_POSITIONS, False))  # type: ignore[attr-defined]
        except EnvironmentMismatchError:
            if control == "track":
                raise
            return None
    if control == "track" and not fits:
        raise EnvironmentMismatchError(
            "CPGPrior(control='track') needs an environment of MuJoCo with one action for each "
            f"actuator, got {env}. Say where observations have the joints (position=, velocity=), "
            "or let targets be the commands: control='direct'."
        )
    return found if fits else None
