"""A central pattern generator that a policy modulates."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from sb3_hds.core.declarations import Actuator, Channel
from sb3_hds.core.transforms.base import (
    InnerAction,
    InnerObs,
    MemoryVector,
    OuterAction,
    Signals,
    StatefulTransform,
    like,
    namespace,
)
from sb3_hds.core.transforms.oscillators import advance_amplitude, advance_phase, period
from sb3_hds.errors import ParameterError

_PER_JOINT = ("amplitude", "offset", "phase", "kp", "kd", "action_range")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rhythm(StatefulTransform):
    r"""
    Oscillators :math:`q_i^* = a_i \sin(\theta_i + \varphi_i) + b_i` that a policy adjusts by
    actions :math:`\alpha` from -1 to 1.

    All joints share one clock: the elapsed share of the cycle, from 0 to 1. The memory holds its
    sine and cosine, and with ``"parameters"`` the amplitudes and their rates.

    The commands are :math:`u = k_p (q^* - q) - k_d\,\dot q`, or :math:`u = q^*` if ``position`` is
    empty, clipped to the limits of the actuators.

    :param mode: ``"offset"``: :math:`q^* + \rho\,\alpha`; ``"residual"``: the command
        :math:`u + \rho\,\alpha`; ``"parameters"``: a factor for each amplitude, and one for both
        frequencies, within ``amplitude_factor`` (linear) and ``frequency_factor`` (geometric);
        with the defaults, an action of 0 leaves the gait unchanged
    :param omega_swing: [rad/s]
    :param omega_stance: [rad/s]
    :param amplitude: :math:`a`, per joint or one for all [rad]
    :param offset: :math:`b`, per joint or one for all [rad]
    :param phase: :math:`\varphi`, per joint or one for all [rad]
    :param kp: command per rad
    :param kd: command per rad/s
    :param action_range: :math:`\rho`, in rad for ``"offset"``, in commands for ``"residual"``
    :param amplitude_factor: smallest and largest
    :param frequency_factor: smallest and largest, above 0
    :param amplitude_gain: how fast amplitudes follow their commands [1/s]
    :param position: index in the observation of the joint position of each actuator
    :param velocity: index in the observation of the joint velocity of each actuator
    :param dt: control interval [s]
    :raises ParameterError: for numbers out of range
    """

    name: ClassVar[str] = "rhythm"
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
    amplitude_factor: Sequence[float] = (0.0, 2.0)
    frequency_factor: Sequence[float] = (0.5, 2.0)
    amplitude_gain: float = 50.0
    position: Sequence[int] = ()
    velocity: Sequence[int] = ()
    dt: float

    def __post_init__(self) -> None:
        super().__post_init__()
        wanted = f"one of {', '.join(map(repr, self.modes))}"
        self.refuse_unless("mode", self.mode in self.modes, wanted)
        for name in ("omega_swing", "omega_stance", "amplitude_gain", "dt"):
            self.refuse_unless(name, 0.0 < getattr(self, name) < math.inf, "above 0 and finite")
        for name, least in (("amplitude_factor", "0 <="), ("frequency_factor", "0 <")):
            self.refuse_unless(name, len(getattr(self, name)) == 2, "smallest and largest")
            low, high = getattr(self, name)
            fine = 0.0 <= low < high < math.inf and (low > 0.0 or least == "0 <=")
            self.refuse_unless(name, fine, f"{least} smallest < largest")
        for name in _PER_JOINT:
            values = np.asarray(getattr(self, name), float)
            self.refuse_unless(name, bool(np.isfinite(values).all()), "finite")
        both = len(self.position) == len(self.velocity)
        self.refuse_unless("velocity", both, f"as many as positions ({len(self.position)})")

    def sized(self, n: int) -> "Rhythm":
        """
        :return: the same with all values per joint, for ``n`` joints
        :raises ParameterError: if a field has another number of values
        """
        per_joint = [getattr(self, name) for name in _PER_JOINT]
        if all(isinstance(values, tuple) and len(values) == n for values in per_joint):
            return self
        found = {}
        for name in _PER_JOINT:
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
        """Number of joints of a rhythm that is :meth:`sized`."""
        return len(self.amplitude)

    @property
    def n_actions(self) -> int:
        """Length of the policy's action."""
        return self.n_joints + (self.mode == "parameters")

    def remembers(self, below: Signals) -> tuple[Channel, ...]:
        """
        :return: sine and cosine of the clock, then amplitudes and their rates
        :raises ParameterError: for another number of joints, or entries that are not observed
        """
        n, n_seen = len(below.actuators), len(below.channels)
        self.sized(n)
        if len(self.position) not in (0, n):
            raise ParameterError(
                f"Rhythm has {len(self.position)} entries in position, and there are {n} "
                "actuators. Pass one for each, or none: then targets are the commands."
            )
        if not all(0 <= i < n_seen for i in (*self.position, *self.velocity)):
            raise ParameterError(
                f"Rhythm reads joints from the entries {list(self.position)} and "
                f"{list(self.velocity)}, but an observation has {n_seen}."
            )
        clock = Channel("sin(clock)", "1", -1.0, 1.0), Channel("cos(clock)", "1", -1.0, 1.0)
        if self.mode != "parameters":
            return clock
        # Critically damped amplitudes that start at rest within the range stay in it, and their
        # rates do not exceed the gain times its width.
        least, most = self.amplitude_factor
        width, names = most - least, [a.name for a in below.actuators]
        radii = [
            Channel(f"amplitude of {name}", "1", least - width, most + width) for name in names
        ]
        rates = [Channel(f"rate of it / gain, {name}", "1", -width, width) for name in names]
        return (*clock, *radii, *rates)

    def start(self, obs: InnerObs, below: Signals) -> MemoryVector:
        radii, n = [], len(below.actuators)
        if self.mode == "parameters":
            radii = [0.5 * sum(self.amplitude_factor)] * n + [0.0] * n
        return namespace(obs).asarray(np.array([0.0, 1.0, *radii]), dtype=obs.dtype)

    def actuators(self, below: Signals) -> tuple[Actuator, ...]:
        names = [f"{self.mode} of {a.name}" for a in below.actuators]
        if self.mode == "parameters":
            names.append("frequency")
        return tuple(Actuator(name, "1", -1.0, 1.0) for name in names)

    def act(
        self, action: OuterAction, obs: InnerObs, memory: MemoryVector, below: Signals
    ) -> tuple[InnerAction, MemoryVector]:
        rhythm, chosen = self.sized(len(below.actuators)), action.clip(-1.0, 1.0)
        target, after = rhythm.target(chosen, memory)
        position, velocity = rhythm.joints_in(obs)
        return below.clip(rhythm.command(chosen, target, position, velocity)), after

    def joints_in(
        self, obs: InnerObs
    ) -> tuple[Float[Any, " act"] | None, Float[Any, " act"] | None]:
        """:return: positions and velocities in an observation; None if ``position`` is empty"""
        if not self.position:
            return None, None
        return obs[np.array(self.position)], obs[np.array(self.velocity)]

    def target(
        self, action: OuterAction, memory: MemoryVector
    ) -> tuple[Float[Any, " act"], MemoryVector]:
        """
        For a rhythm that is :meth:`sized`.

        :param action: of the policy, from -1 to 1
        :return: target positions in the middle of the interval, and the memory after it
        """
        xp, dt = namespace(memory), self.dt
        cycle, n = period(self.omega_swing, self.omega_stance), self.n_joints
        clock = xp.arctan2(memory[0], memory[1]) / (2.0 * math.pi)
        rate, radius, after = 1.0, 1.0, memory[2:]
        if self.mode == "parameters":
            wanted = _within(action[:n], self.amplitude_factor)
            slowest, fastest = self.frequency_factor
            rate = slowest * (fastest / slowest) ** (0.5 * (action[n] + 1.0))
            gain = self.amplitude_gain
            now = memory[2 : 2 + n], gain * memory[2 + n :]
            radius, _ = advance_amplitude(*now, wanted, 0.5 * dt, gain)
            radius_after, speed_after = advance_amplitude(*now, wanted, dt, gain)
            after = xp.concatenate([radius_after, speed_after / gain])
        time = (clock * cycle + 0.5 * rate * dt) % cycle
        phase = advance_phase(like(memory, self.phase), time, self.omega_swing, self.omega_stance)
        target = radius * like(memory, self.amplitude) * xp.sin(phase) + like(memory, self.offset)
        if self.mode == "offset":
            target = target + like(memory, self.action_range) * action
        angle = 2.0 * math.pi * (clock + rate * dt / cycle)
        clock_after = xp.stack([xp.sin(angle), xp.cos(angle)])
        return target, xp.concatenate([clock_after, after]).astype(memory.dtype)

    def command(
        self,
        action: OuterAction,
        target: Float[Any, " act"],
        position: Float[Any, " act"] | None,
        velocity: Float[Any, " act"] | None,
    ) -> Float[Any, " act"]:
        """
        :param position: of the joints; None: the targets are the commands
        :param velocity: of the joints; None with ``position``
        :return: the commands of the actuators, not clipped
        """
        command = target
        if position is not None:
            kp, kd = like(target, self.kp), like(target, self.kd)
            command = kp * (target - position) - kd * velocity
        if self.mode == "residual":
            command = command + like(target, self.action_range) * action
        return command


def _within(share: Any, ends: Sequence[float]) -> Any:
    """Map [-1, 1] linearly onto an interval."""
    return ends[0] + 0.5 * (share + 1.0) * (ends[1] - ends[0])
