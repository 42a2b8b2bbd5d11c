"""Effects between the command and the plant."""

from typing import TYPE_CHECKING

import jax.numpy as jnp

from sb3_hds.core import ActionEffect, Memory, Parameter, Params, Ranges, Scalar
from sb3_hds.effects.shapes import Delayed, beyond

if TYPE_CHECKING:
    from sb3_hds.core import Twin

# The command before an episode.
_AT_REST = 0.0
# Smaller time constants [sub-steps] count as zero: exp(-1000) is zero.
_INSTANT = 1e-3
# Values between which equation errors are interpolated: lags [sampling intervals], up to a share of
# the period of the motion; widths [root mean square commands]; limits [largest commands].
_LAGS = (0.0, 0.5, 1.0, 1.6, 2.5, 4.0, 6.0, 9.0, 13.0, 18.0)
_LONGEST_SHARE = 0.3
_WIDTHS = (0.0, 0.1, 0.2, 0.36, 0.56, 0.84, 1.2, 1.7, 2.4)
_LIMITS = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2)


class TorqueGain(ActionEffect):
    r"""
    Scales the command: the drive is stronger or weaker than in the model.

    .. math:: u' = k\,u

    Source: Armstrong-Hélouvry, Dupont and Canudas de Wit, *A survey of models, analysis tools and
    compensation methods for the control of machines with friction*, Automatica 30(7), 1994.
    """

    name = "torque_gain"
    parameters = {"gain": Parameter(null=1.0, scale=0.1, unit="1", lower=0.0, upper=10.0)}
    explanation = "The drive is stronger or weaker than the model says, in proportion."
    source = "Armstrong-Hélouvry et al. 1994"
    equivalents = {
        "directional_gain": "while commands keep their sign",
        "parameter.mass": "where the mass scales inertia and weight alike: a gain is one over it",
    }

    def act(
        self, command: Scalar, memory: Memory, h: float, params: Params
    ) -> tuple[Scalar, Memory]:
        return params["gain"] * command, memory


class MotorLag(ActionEffect):
    r"""
    The drive follows its command with a first-order lag, integrated exactly.

    .. math:: T\,\dot u' = u - u'

    The plant receives the mean of :math:`u'` over each sub-step. An episode starts with the drive
    at rest. At :math:`T = 0` the derivative is the one-sided derivative towards larger :math:`T`.

    Source: Åström and Murray, *Feedback Systems*, Princeton University Press 2021, section 3.
    """

    name = "motor_lag"
    parameters = {"time_constant": Parameter(null=0.0, scale=0.02, unit="s", lower=0.0, upper=2.0)}
    explanation = "The drive takes time to follow its command, as a motor with inductance does."
    source = "Åström and Murray 2021, section 3"
    interpolated = "time_constant"
    equivalents = {"action_delay": "where commands change slowly compared with either"}

    def grid(self, ranges: Ranges) -> tuple[dict[str, float], ...]:
        longest = min(_LONGEST_SHARE * ranges.period, self.parameters["time_constant"].upper)
        values = [lag * ranges.dt for lag in _LAGS]
        return tuple({"time_constant": t} for t in values if t <= max(longest, ranges.dt))

    def memory(self, twin: "Twin") -> Memory:
        return jnp.asarray(_AT_REST)

    def act(
        self, command: Scalar, memory: Memory, h: float, params: Params
    ) -> tuple[Scalar, Memory]:
        time_constant = params["time_constant"]
        decay = jnp.exp(-h / jnp.maximum(time_constant, _INSTANT * h))
        after = command + (memory - command) * decay
        mean = command + (memory - command) * (1.0 - decay) * time_constant / h
        return mean, after


class ActionDelay(Delayed, ActionEffect):
    r"""
    Commands arrive late.

    .. math:: u'(t) = u(t - d)

    Commands are held over a control interval, and the plant receives their mean over each sub-step,
    so the delay need not be a multiple of either. Attach it before effects that change a command
    within the interval. Before the first command of an episode, zero arrives. If the delay is a
    multiple of the sub-step, or zero, the derivative is the one-sided one towards larger delays.

    Source: Åström and Murray, *Feedback Systems*, Princeton University Press 2021, section 10.

    :param longest: option; longest delay that can be simulated [s]
    :raises EffectError: unless it is positive
    """

    name = "action_delay"
    explanation = "Commands reach the drive late, as over a bus or a radio link."
    source = "Åström and Murray 2021, section 10"
    interpolated = "delay"
    equivalents = {
        "motor_lag": "where commands change slowly compared with either",
        "sensor_delay": "where every channel is as late and nothing is fed back",
    }

    def grid(self, ranges: Ranges) -> tuple[dict[str, float], ...]:
        """Interpolation is exact: held commands that arrive within an interval mix linearly."""
        longest = min(_LONGEST_SHARE * ranges.period, self.longest)
        n = max(1, min(int(longest / ranges.dt + 1e-9), 24))
        return tuple({"delay": k * ranges.dt} for k in range(n + 1))

    def memory(self, twin: "Twin") -> Memory:
        """The commands of the last control intervals, the latest first, and a clock."""
        intervals = self.remembered(twin.dt)
        return {
            "commands": jnp.full(intervals, _AT_REST),
            "elapsed": jnp.asarray(twin.dt),
            "interval": jnp.asarray(twin.dt),
        }

    def act(
        self, command: Scalar, memory: Memory, h: float, params: Params
    ) -> tuple[Scalar, Memory]:
        """``elapsed`` is the time from the start of the control interval to this sub-step."""
        interval = memory["interval"]
        begins = memory["elapsed"] > interval - 0.5 * h
        elapsed = jnp.where(begins, 0.0, memory["elapsed"])
        commands = jnp.where(begins, jnp.roll(memory["commands"], 1), memory["commands"])
        commands = commands.at[0].set(command)
        # Command i was held from i intervals before this one to one interval later.
        begin = elapsed - params["delay"]
        held_from = -interval * jnp.arange(commands.shape[0])
        held_to = jnp.where(jnp.arange(commands.shape[0]) == 0, jnp.inf, held_from + interval)
        # Not minimum and maximum, which halve the derivative where their arguments are equal.
        until = jnp.where(begin + h <= held_to, begin + h, held_to)
        since = jnp.where(begin > held_from, begin, held_from)
        arrives = (begin + h > held_from) & (begin <= held_to)
        shares = jnp.where(arrives, until - since, 0.0) / h
        arrived = jnp.sum(shares * commands)
        return arrived, {"commands": commands, "elapsed": elapsed + h, "interval": interval}


class DirectionalGain(ActionEffect):
    r"""
    Scales the command, by a different factor for each sign.

    .. math:: u' = \begin{cases} k_+ u & u > 0 \\ k_- u & u \le 0 \end{cases}

    The derivative by the factor of the other sign is zero. At :math:`u = 0`, the derivative by the
    command is :math:`k_-`.

    Source: Armstrong-Hélouvry, Dupont and Canudas de Wit, *A survey of models, analysis tools and
    compensation methods for the control of machines with friction*, Automatica 30(7), 1994.
    """

    name = "directional_gain"
    parameters = {
        "gain_pos": Parameter(null=1.0, scale=0.1, unit="1", lower=0.0, upper=10.0),
        "gain_neg": Parameter(null=1.0, scale=0.1, unit="1", lower=0.0, upper=10.0),
    }
    explanation = "The drive is stronger one way than the other."
    source = "Armstrong-Hélouvry et al. 1994"
    equivalents = {"torque_gain": "while commands keep their sign"}

    def act(
        self, command: Scalar, memory: Memory, h: float, params: Params
    ) -> tuple[Scalar, Memory]:
        gain = jnp.where(command > 0.0, params["gain_pos"], params["gain_neg"])
        return gain * command, memory


class DeadZone(ActionEffect):
    r"""
    Small commands have no effect, and larger ones are reduced by the same amount.

    .. math:: u' = \max(u - w / 2, 0) + \min(u + w / 2, 0)

    The zone extends from :math:`-w / 2` to :math:`w / 2`. Inside, the derivative is zero, so
    planning gets no gradient there.

    Source: Slotine and Li, *Applied Nonlinear Control*, Prentice Hall 1991, section 5.2.
    """

    name = "dead_zone"
    parameters = {"width": Parameter(null=0.0, scale=0.1, unit="command unit", lower=0.0)}
    explanation = "Small commands do not move the drive, and larger ones lose as much."
    source = "Slotine and Li 1991, section 5.2"
    interpolated = "width"
    equivalents = {"coulomb_friction": "while the joint moves the way it is driven"}

    def grid(self, ranges: Ranges) -> tuple[dict[str, float], ...]:
        """Widths below the largest command: a wider zone would be a gain of zero."""
        widths = [share * ranges.command for share in _WIDTHS]
        return tuple({"width": w} for w in widths if w < ranges.largest)

    def act(
        self, command: Scalar, memory: Memory, h: float, params: Params
    ) -> tuple[Scalar, Memory]:
        return beyond(command, 0.5 * params["width"]), memory


class Saturation(ActionEffect):
    r"""
    The drive limits its command.

    .. math:: u' = \min(\max(u, -l), l)

    :math:`l = 0` stands for no limit, because every effect is absent at its null. The effect
    therefore jumps at zero, where it has no derivative, and a search must start at a limit that
    commands reach. The derivative by :math:`l` is the sign of a command beyond the limit, and zero
    for a command within it.

    Source: Slotine and Li, *Applied Nonlinear Control*, Prentice Hall 1991, section 5.2.
    """

    name = "saturation"
    parameters = {"limit": Parameter(null=0.0, scale=0.2, unit="command unit", lower=0.0)}
    explanation = (
        "The drive does not reach the largest commands, because of its current or voltage."
    )
    source = "Slotine and Li 1991, section 5.2"
    interpolated = "limit"

    def grid(self, ranges: Ranges) -> tuple[dict[str, float], ...]:
        return tuple({"limit": share * ranges.largest} for share in _LIMITS if ranges.largest)

    def act(
        self, command: Scalar, memory: Memory, h: float, params: Params
    ) -> tuple[Scalar, Memory]:
        limited = command - beyond(command, params["limit"])
        return jnp.where(params["limit"] > 0.0, limited, command), memory
