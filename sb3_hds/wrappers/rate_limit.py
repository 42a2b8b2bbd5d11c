"""Commands that do not jump."""

from collections.abc import Sequence

import gymnasium
import numpy as np

from sb3_hds.core import RateLimit
from sb3_hds.errors import ParameterError
from sb3_hds.wrappers.action_layer import TransformLayer
from sb3_hds.wrappers.interval import interval_of


class ActionRateLimit(TransformLayer):
    """
    Commands change by at most so much per second. The last command is appended to observations.

    :param env: its actions are a bounded Box with one axis
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
        most = (rates * interval).tolist()
        arguments = {
            "max_rate": max_rate,
            "dt": dt,
            "observe_state": observe_state,
            "store": store,
        }
        transform = RateLimit(max_change=most, observed=observe_state)
        super().__init__(env, transform, store, arguments)
