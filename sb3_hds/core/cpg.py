"""A rhythm under a policy: what it adds to actions, what it remembers and shows."""

import dataclasses
import math
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from sb3_hds.core.oscillators import AmplitudeState, advance_amplitude, advance_phase, period
from sb3_hds.errors import ParameterError

_PER_JOINT = ("amplitude", "offset", "phase", "kp", "kd")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rhythm:
    r"""
    Oscillators :math:`q_i^* = a_i \sin(\theta_i + \varphi_i) + b_i` that a policy adjusts, with
    actions :math:`\alpha` from -1 to 1. Fields are plain data; the methods take arrays of NumPy and
    JAX alike, so that the wrapper of an environment and a twin can run the same lines.

    All joints share one clock :math:`c`, the share of the cycle that has passed, from 0 to 1.

    :param mode: ``"offset"``: :math:`q^* + \rho\,\alpha`; ``"residual"``: the command
        :math:`u + \rho\,\alpha`; ``"parameters"``: factors on each amplitude, and one on both
        frequencies, from ``amplitude_factor`` (linear) and ``frequency_factor`` (geometric): with
        the defaults, an action of 0 is the gait as it was passed
    :param omega_swing: [rad/s]
    :param omega_stance: [rad/s]
    :param amplitude: per joint, or one for all [rad]
    :param offset: likewise
    :param phase: likewise
    :param kp: command per rad
    :param kd: command per rad/s
    :param action_range: :math:`\rho`, in rad for ``"offset"``, in commands for ``"residual"``
    :param amplitude_factor: smallest and largest
    :param frequency_factor: smallest and largest, above 0
    :param amplitude_gain: how fast amplitudes follow their commands [1/s]
    """

    modes: ClassVar[tuple[str, ...]] = ("offset", "residual", "parameters")

    mode: str = "offset"
    omega_swing: float
    omega_stance: float
    amplitude: Any = 1.0
    offset: Any = 0.0
    phase: Any = 0.0
    kp: Any = 1.0
    kd: Any = 0.05
    action_range: Any = 0.1
    amplitude_factor: tuple[float, float] = (0.0, 2.0)
    frequency_factor: tuple[float, float] = (0.5, 2.0)
    amplitude_gain: float = 50.0

    def __post_init__(self) -> None:
        if self.mode not in self.modes:
            wanted = ", ".join(map(repr, self.modes))
            raise ParameterError(f"Rhythm(mode={self.mode!r}): mode must be one of {wanted}.")
        for name in ("omega_swing", "omega_stance", "amplitude_gain"):
            if not (math.isfinite(value := getattr(self, name)) and value > 0.0):
                raise ParameterError(f"Rhythm({name}={value}): {name} must be above 0 and finite.")
        for name in ("amplitude_factor", "frequency_factor"):
            low, high = getattr(self, name)
            if not (0.0 <= low < high < math.inf and (low > 0.0 or name[0] == "a")):
                raise ParameterError(f"Rhythm({name}={[low, high]}): needs 0 <= lowest < highest.")
        for name in (*_PER_JOINT, "action_range"):
            if not np.isfinite(np.asarray(getattr(self, name), float)).all():
                raise ParameterError(
                    f"Rhythm({name}={getattr(self, name)}): {name} must be finite."
                )

    def sized(self, n: int) -> "Rhythm":
        """
        :return: the same with one number for each of ``n`` joints
        :raises ParameterError: if it has another number of them
        """
        found = {}
        for name in (*_PER_JOINT, "action_range"):
            values = np.asarray(getattr(self, name), float)
            if values.shape not in ((), (n,)):
                raise ParameterError(
                    f"Rhythm has {values.size} values of {name}, and there are {n} actuators. Pass "
                    "one number, or one for each."
                )
            found[name] = tuple(np.broadcast_to(values, (n,)).tolist())
        return dataclasses.replace(self, **found)

    @property
    def n_joints(self) -> int:
        """How many there are, once it is sized."""
        return len(self.amplitude)

    @property
    def n_actions(self) -> int:
        """How many numbers the policy chooses."""
        return self.n_joints + (self.mode == "parameters")

    @property
    def memory_names(self) -> tuple[str, ...]:
        """What is remembered, and shown: sine and cosine of the clock, then amplitudes."""
        clock = ("sin(clock)", "cos(clock)")
        if self.mode != "parameters":
            return clock
        joints = range(self.n_joints)
        return (*clock, *(f"r[{i}]" for i in joints), *(f"dr/dt[{i}] / gain" for i in joints))

    def start(self) -> Float[np.ndarray, " memory"]:
        """:return: the memory at the start of an episode"""
        memory = np.zeros(len(self.memory_names))
        memory[1] = 1.0
        if self.mode == "parameters":
            memory[2 : 2 + self.n_joints] = 0.5 * sum(self.amplitude_factor)
        return memory

    def target(
        self, action: Float[Any, " outer"], memory: Float[Any, " memory"], dt: float
    ) -> tuple[Float[Any, " act"], Float[Any, " memory"]]:
        """
        :param action: of the policy, from -1 to 1
        :param dt: how long it acts [s]
        :return: what the joints aim at in the middle of that time, and the memory after it
        """
        xp = memory.__array_namespace__()
        cycle, n = period(self.omega_swing, self.omega_stance), self.n_joints
        clock = xp.arctan2(memory[0], memory[1]) / (2.0 * math.pi)
        rate, radius, after = 1.0, 1.0, memory[2:]
        if self.mode == "parameters":
            wanted = _within(action[:n], self.amplitude_factor)
            slowest, fastest = self.frequency_factor
            rate = slowest * (fastest / slowest) ** (0.5 * (action[n] + 1.0))
            gain, still = self.amplitude_gain, xp.zeros_like(wanted)
            state = AmplitudeState(memory[2 : 2 + n], gain * memory[2 + n :], still)
            radius = advance_amplitude(state, wanted, 0.0, 0.5 * dt, gain).radius
            settled = advance_amplitude(state, wanted, 0.0, dt, gain)
            after = xp.concatenate([settled.radius, settled.speed / gain])
        gone = (clock * cycle + 0.5 * rate * dt) % cycle
        phase = xp.asarray(self.phase, dtype=memory.dtype)
        phase = advance_phase(phase, gone, self.omega_swing, self.omega_stance)
        aim = radius * xp.asarray(self.amplitude) * xp.sin(phase) + xp.asarray(self.offset)
        if self.mode == "offset":
            aim = aim + xp.asarray(self.action_range) * action
        turned = 2.0 * math.pi * (clock + rate * dt / cycle)
        shown = xp.stack([xp.sin(turned), xp.cos(turned)])
        return aim, xp.concatenate([shown, after]).astype(memory.dtype)

    def command(
        self,
        action: Float[Any, " outer"],
        target: Float[Any, " act"],
        position: Float[Any, " act"] | None,
        velocity: Float[Any, " act"] | None,
    ) -> Float[Any, " act"]:
        """
        :param position: of the joints; None: the targets are the commands
        :param velocity: likewise
        :return: what the actuators are told, not clipped
        """
        xp = action.__array_namespace__()
        command = target
        if position is not None:
            kp, kd = xp.asarray(self.kp), xp.asarray(self.kd)
            command = kp * (target - position) - kd * velocity
        if self.mode == "residual":
            command = command + xp.asarray(self.action_range) * action
        return command


def _within(share: Any, ends: tuple[float, float]) -> Any:
    """From -1 to 1 onto an interval."""
    return ends[0] + 0.5 * (share + 1.0) * (ends[1] - ends[0])
