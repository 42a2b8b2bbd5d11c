"""What happens to a command on its way to the plant."""

import math
from typing import TYPE_CHECKING

import jax.numpy as jnp

from sb3_hds.core import ActionEffect, Memory, Parameter, Params, Scalar

if TYPE_CHECKING:
    from sb3_hds.core import Twin

# A command that no drive has yet received.
_AT_REST = 0.0
# Longest delay that can be simulated [s].
_LONGEST_DELAY = 0.2
# Time constants below this share of a sub-step act at once.
_INSTANT = 1e-3


class TorqueGain(ActionEffect):
    r"""
    The drive does more, or less, than it is told.

    .. math:: u' = k\,u

    Source: Armstrong-Hélouvry, Dupont and Canudas de Wit, *A survey of models, analysis tools and
    compensation methods for the control of machines with friction*, Automatica 30(7), 1994.
    """

    name = "torque_gain"
    parameters = {"gain": Parameter(null=1.0, scale=0.1, unit="1", lower=0.0, upper=10.0)}
    explanation = "The drive is stronger or weaker than the model says, in proportion."
    source = "Armstrong-Hélouvry et al. 1994"

    def act(
        self, command: Scalar, memory: Memory, h: float, params: Params
    ) -> tuple[Scalar, Memory]:
        return params["gain"] * command, memory


class MotorLag(ActionEffect):
    r"""
    The drive follows its command with a delay of first order, exactly integrated.

    .. math:: T\,\dot u' = u - u'

    What reaches the plant during a sub-step is the mean of :math:`u'` over it. At the start of an
    episode the drive is at rest.

    Source: Åström and Murray, *Feedback Systems*, Princeton University Press 2021, section 3.
    """

    name = "motor_lag"
    parameters = {"time_constant": Parameter(null=0.0, scale=0.02, unit="s", lower=0.0, upper=2.0)}
    explanation = "The drive takes time to reach what it is told, as a motor with inductance does."
    source = "Åström and Murray 2021, section 3"

    def memory(self, twin: "Twin") -> Memory:
        return jnp.asarray(_AT_REST)

    def act(
        self, command: Scalar, memory: Memory, h: float, params: Params
    ) -> tuple[Scalar, Memory]:
        ratio = h / jnp.maximum(params["time_constant"], _INSTANT * h)
        kept = jnp.exp(-ratio)
        after = command + (memory - command) * kept
        mean = command + (memory - command) * (1.0 - kept) / ratio
        at_once = params["time_constant"] <= 0.0
        return jnp.where(at_once, command, mean), jnp.where(at_once, command, after)


class ActionDelay(ActionEffect):
    r"""
    Commands arrive late.

    .. math:: u'(t) = u(t - d)

    Commands are held over a control interval, and what reaches the plant during a sub-step is their
    mean over it, so the delay need not be a multiple of either. Attach it before effects that
    change a command within the interval. Before the first command of an episode, zero arrives.

    Source: Åström and Murray, *Feedback Systems*, Princeton University Press 2021, section 10.
    """

    name = "action_delay"
    parameters = {
        "delay": Parameter(null=0.0, scale=0.02, unit="s", lower=0.0, upper=_LONGEST_DELAY)
    }
    explanation = "Commands reach the drive late, as over a bus or a radio link."
    source = "Åström and Murray 2021, section 10"

    def memory(self, twin: "Twin") -> Memory:
        """The commands of the last control intervals, the latest first, and a clock."""
        intervals = math.ceil(_LONGEST_DELAY / twin.dt - 1e-9) + 1
        return {
            "commands": jnp.full(intervals, _AT_REST),
            "elapsed": jnp.asarray(twin.dt),
            "interval": jnp.asarray(twin.dt),
        }

    def act(
        self, command: Scalar, memory: Memory, h: float, params: Params
    ) -> tuple[Scalar, Memory]:
        """``elapsed`` is the time since the control interval began, up to this sub-step."""
        interval = memory["interval"]
        begins = memory["elapsed"] > interval - 0.5 * h
        elapsed = jnp.where(begins, 0.0, memory["elapsed"])
        commands = jnp.where(begins, jnp.roll(memory["commands"], 1), memory["commands"])
        commands = commands.at[0].set(command)
        # Command i was held from i intervals before this one to one interval later.
        begin = elapsed - params["delay"]
        held_from = -interval * jnp.arange(commands.shape[0])
        held_to = jnp.where(jnp.arange(commands.shape[0]) == 0, jnp.inf, held_from + interval)
        overlap = jnp.minimum(begin + h, held_to) - jnp.maximum(begin, held_from)
        shares = jnp.maximum(overlap, 0.0) / h
        arrived = jnp.sum(shares * commands)
        return arrived, {"commands": commands, "elapsed": elapsed + h, "interval": interval}
