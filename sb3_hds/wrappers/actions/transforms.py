"""Filters of commands, a cost on jumps of the action, and histories in the observation."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium
import numpy as np

from sb3_hds.core import Continuity, Delay, History, LowPass, RateLimit
from sb3_hds.core.transforms.filters import LOWEST_CUTOFF
from sb3_hds.errors import ParameterError
from sb3_hds.wrappers.action_layer import TransformLayer
from sb3_hds.wrappers.interval import interval_of

# The order is also the number of entries per action that are appended to observations.
_HIGHEST_ORDER = 8


class LowPassAction(TransformLayer):
    """
    Butterworth low-pass filter of each command. The filter's state is appended to observations.

    From second order on, the filter overshoots a step (4 % at second order); commands are clipped
    to their limits. Apply joint limits below it, since a filter would delay their corrections.

    Source: Butterworth, *On the theory of filter amplifiers*, Experimental Wireless 7, 1930;
    bilinear transform as in ``scipy.signal.butter``, see :class:`sb3_hds.core.LowPass`.

    :param env: with a bounded Box of one axis as action space
    :param cutoff: frequency at which half of the power passes [Hz], below half the control rate
    :param order: 1 to 8
    :param dt: control interval [s]; default: the environment's own ``dt`` or ``tau``
    :param observe_state: whether the state is appended, ``order`` numbers per action; without it,
        the task is not Markov
    :param store: ``"executed"``: learners store the filtered command
    :raises ParameterError: for a cut-off or an order out of range, or an unknown interval
    """

    def __init__(
        self,
        env: gymnasium.Env,
        cutoff: float,
        order: int = 2,
        *,
        dt: float | None = None,
        observe_state: bool = True,
        store: str = "raw",
    ) -> None:
        interval = interval_of(env, ParameterError) if dt is None else dt
        if not 0.0 < interval < math.inf:
            raise ParameterError(f"LowPassAction(dt={dt!r}): dt must be above 0 s.")
        if not LOWEST_CUTOFF <= cutoff * interval < 0.5:
            raise ParameterError(
                f"LowPassAction(cutoff={cutoff!r}): with a step of {interval:g} s, cutoff must be "
                f"at least {LOWEST_CUTOFF / interval:g} Hz and below {0.5 / interval:g} Hz, half "
                "the control rate."
            )
        if order not in range(1, _HIGHEST_ORDER + 1):
            raise ParameterError(
                f"LowPassAction(order={order!r}): order must be a whole number from 1 to "
                f"{_HIGHEST_ORDER}."
            )
        transform = LowPass(cutoff=cutoff * interval, order=order, observed=observe_state)
        super().__init__(
            env, transform, store, cutoff=cutoff, order=order, dt=dt, observe_state=observe_state
        )


class ActionDelay(TransformLayer):
    """
    Delays commands by an integer number of steps. Commands in transit are appended to observations.

    Learners store the raw action: the executed one was chosen in an earlier step.

    :param env: with a bounded Box of one axis as action space
    :param steps: length of the delay [control intervals]
    :param observe_state: whether the commands in transit are appended, the oldest first; without
        them, the task is not Markov
    :param store: ``"raw"``
    :raises ParameterError: unless ``steps`` is a whole number of at least 1
    """

    stores: ClassVar[tuple[str, ...]] = ("raw",)

    def __init__(
        self, env: gymnasium.Env, steps: int, *, observe_state: bool = True, store: str = "raw"
    ) -> None:
        transform = Delay(steps=steps, observed=observe_state)
        super().__init__(env, transform, store, steps=steps, observe_state=observe_state)


class ActionRateLimit(TransformLayer):
    """
    Limits the rate of change of commands. The previous command is appended to observations.

    :param env: with a bounded Box of one axis as action space
    :param max_rate: [command unit / s], one number or one per action
    :param dt: control interval [s]; default: the environment's own ``dt`` or ``tau``
    :param observe_state: whether the last command is appended; without it, the task is not Markov
    :param store: ``"executed"``: learners store the limited command
    :raises ParameterError: for a rate that is not positive, or an unknown interval
    """

    def __init__(
        self,
        env: gymnasium.Env,
        max_rate: float | Sequence[float],
        *,
        dt: float | None = None,
        observe_state: bool = True,
        store: str = "raw",
    ) -> None:
        interval = interval_of(env, ParameterError) if dt is None else dt
        rates = np.asarray(max_rate, float)
        if not (rates > 0.0).all():
            raise ParameterError(
                f"ActionRateLimit(max_rate={max_rate}): max_rate must be above 0, in units of the "
                "action per second, one number or one for each."
            )
        transform = RateLimit(max_change=(rates * interval).tolist(), observed=observe_state)
        super().__init__(
            env, transform, store, max_rate=max_rate, dt=dt, observe_state=observe_state
        )


class ContinuityCost(TransformLayer):
    """
    Subtracts ``weight`` times the squared change of the action from the reward. Actions pass
    unchanged; the last one is appended to observations, so that the task stays Markov.

    ``info["continuity_cost"]`` is the penalty.

    :param env: with a bounded Box of one axis as action space
    :param weight: [reward / command unit squared], at least 0
    :param observe_state: whether the last action is appended; without it, the task is not Markov
    :param store: ``"raw"`` or ``"executed"``, which are the same here
    :raises ParameterError: for a weight that is negative or not finite
    """

    alters_commands: ClassVar[bool] = False

    def __init__(
        self,
        env: gymnasium.Env,
        weight: float,
        *,
        observe_state: bool = True,
        store: str = "raw",
    ) -> None:
        transform = Continuity(weight=float(weight), observed=observe_state)
        super().__init__(env, transform, store, weight=weight, observe_state=observe_state)

    def extra_info(self) -> dict[str, Any]:
        return {"continuity_cost": self.penalty()}


class HistoryObservation(TransformLayer):
    """
    Appends the previous observations and actions, the latest first; zeros before an episode.
    Actions are the inputs of this layer: outside other layers, the raw ones.

    :param env: its observations are a Box with one axis, its actions a bounded one
    :param n_observations: number of observations before the current one
    :param n_actions: number of actions before the next one
    :raises ParameterError: unless both are whole numbers of at least 0, and one is positive
    """

    alters_commands: ClassVar[bool] = False

    def __init__(
        self,
        env: gymnasium.Env,
        n_observations: int = 1,
        n_actions: int = 1,
        *,
        store: str = "raw",
    ) -> None:
        transform = History(n_observations=n_observations, n_actions=n_actions)
        super().__init__(env, transform, store, n_observations=n_observations, n_actions=n_actions)
