"""A rhythm that a policy adjusts instead of having to find it."""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs

from sb3_hds.core.cpg import Rhythm
from sb3_hds.errors import EnvironmentMismatchError
from sb3_hds.wrappers.actuated_joints import interval_of, joints_of


class CPGPrior(gymnasium.Wrapper, RecordConstructorArgs):
    r"""
    Oscillators move the joints, and the policy's action, from -1 to 1, adjusts them: an offset of
    their targets, a residual on the commands, or their amplitudes and frequency. See
    :class:`~sb3_hds.core.cpg.Rhythm` for the equations.

    Sine and cosine of the clock that all joints share are appended to the observation, and in the
    third mode the amplitudes and their rates: whatever acts is seen, so the task stays Markov.

    In environments of MuJoCo, actuators track their joints, which are read from the environment.
    Elsewhere, or with ``control="direct"``, targets are the commands. Commands are clipped to the
    action space below. ``info["command"]`` is what that was told, ``info["target"]`` the aim.

    In a file of the zoo: ``env_wrapper: [{sb3_hds.wrappers.CPGPrior: {omega_swing: 3.9, ...}}]``.
    :meth:`sb3_hds.OpenLoop.constants` has the gait of a search as these arguments.

    Source: Bellegarda and Ijspeert, *CPG-RL*, RA-L 2022, for parameters; Raffin et al., *Learning
    to exploit elastic actuators for quadruped locomotion*, 2022, for offsets.

    :param env: with a bounded Box of actions, and observations that are a Box, each with one axis
    :param mode: ``"offset"``, ``"residual"`` or ``"parameters"``
    :param omega_swing: [rad/s]
    :param omega_stance: [rad/s]; None: as ``omega_swing``
    :param amplitude: one per actuator, or one for all [rad]
    :param offset: likewise [rad]
    :param phase: likewise [rad]
    :param kp: command per rad
    :param kd: command per rad/s
    :param action_range: of the offset [rad], or of the residual [commands]
    :param amplitude_factor: smallest and largest, for ``"parameters"``
    :param frequency_factor: smallest and largest, likewise
    :param amplitude_gain: how fast amplitudes follow [1/s]
    :param control: ``"track"``, ``"direct"``, or ``"auto"``
    :param dt: how long a step takes [s]; None: as the environment says
    :raises EnvironmentMismatchError: for an environment that this cannot be put around
    :raises ParameterError: for arguments out of range, or of another number than the actuators
    """

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
        dt: float | None = None,
    ) -> None:
        given = {k: v for k, v in locals().items() if k not in ("self", "env", "__class__")}
        RecordConstructorArgs.__init__(self, **given)
        gymnasium.Wrapper.__init__(self, env)
        seen, commands = _boxes(env)
        rhythm = Rhythm(
            mode=mode,
            omega_swing=omega_swing,
            omega_stance=omega_swing if omega_stance is None else omega_stance,
            amplitude=amplitude,
            offset=offset,
            phase=phase,
            kp=kp,
            kd=kd,
            action_range=action_range,
            amplitude_factor=(amplitude_factor[0], amplitude_factor[1]),
            frequency_factor=(frequency_factor[0], frequency_factor[1]),
            amplitude_gain=amplitude_gain,
        )
        self.rhythm = rhythm.sized(commands.shape[0])
        self._commands = commands
        self._joints = _tracked(env, control, commands.shape[0])
        interval = interval_of(env) if dt is None else dt
        if interval is None:
            raise EnvironmentMismatchError(
                f"{env.unwrapped} does not say how long a step is: it has no attribute dt. "
                "Pass dt=SECONDS."
            )
        self._dt = interval
        self._memory = self.rhythm.start()
        self.action_space = spaces.Box(-1.0, 1.0, (self.rhythm.n_actions,), np.float32)
        self.observation_space = self._observations(seen)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        obs, info = self.env.reset(seed=seed, options=options)
        self._memory = self.rhythm.start()
        return self._seen(obs), info

    def step(self, action: Any) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        """:return: as the environment, with ``info["command"]`` and ``info["target"]``"""
        chosen = np.clip(np.asarray(action, float), -1.0, 1.0)
        target, self._memory = self.rhythm.target(chosen, self._memory, self._dt)
        command = self.rhythm.command(chosen, target, *self._readings())
        box = self._commands
        command = np.clip(command, box.low, box.high).astype(box.dtype)
        obs, reward, terminated, truncated, info = self.env.step(command)
        said = {"command": command, "target": target}
        return self._seen(obs), reward, terminated, truncated, info | said

    def _readings(self) -> tuple[np.ndarray | None, np.ndarray | None]:
        if self._joints is None:
            return None, None
        inner: Any = self.env.unwrapped
        return self._joints.of_state(inner.state_vector())

    def _seen(self, obs: Any) -> np.ndarray:
        return np.concatenate([obs, self._memory]).astype(self.observation_space.dtype)

    def _observations(self, below: spaces.Box) -> spaces.Box:
        low, high = -np.ones(2), np.ones(2)
        if self.rhythm.mode == "parameters":
            # From rest within their range, critically damped amplitudes do not leave it, nor do
            # their rates exceed the gain times its width.
            n, (least, most) = self.rhythm.n_joints, self.rhythm.amplitude_factor
            width = most - least
            low = np.concatenate([low, np.full(n, least - width), np.full(n, -width)])
            high = np.concatenate([high, np.full(n, most + width), np.full(n, width)])
        kind = below.dtype
        return spaces.Box(
            np.append(below.low, low).astype(kind),
            np.append(below.high, high).astype(kind),
            dtype=kind.type,
        )


def _boxes(env: gymnasium.Env) -> tuple[spaces.Box, spaces.Box]:
    seen, commands = env.observation_space, env.action_space
    for space in (seen, commands):
        if not isinstance(space, spaces.Box) or len(space.shape) != 1:
            raise EnvironmentMismatchError(
                f"CPGPrior takes observations and actions that are boxes of one axis, got {space}. "
                "Flatten observations first: gymnasium.wrappers.FlattenObservation."
            )
    assert isinstance(seen, spaces.Box) and isinstance(commands, spaces.Box)
    if not commands.is_bounded():
        raise EnvironmentMismatchError(f"CPGPrior clips commands, and {commands} has no bounds.")
    return seen, commands


def _tracked(env: gymnasium.Env, control: str, n: int):
    if control not in ("auto", "track", "direct"):
        raise EnvironmentMismatchError(
            f"CPGPrior(control={control!r}): control must be 'auto', 'track' or 'direct'."
        )
    found = None if control == "direct" else joints_of(env)
    fits = found is not None and len(found.names) == n
    if control == "track" and not fits:
        raise EnvironmentMismatchError(
            "CPGPrior(control='track') needs an environment of MuJoCo with one action for each "
            f"actuator, got {env}. Let targets be the commands: control='direct'."
        )
    return found if fits else None
