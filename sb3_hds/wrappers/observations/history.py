"""A history of observations and actions in the observation."""

from typing import ClassVar

import gymnasium

from sb3_hds.core import History
from sb3_hds.wrappers.action_layer import TransformLayer


class HistoryObservation(TransformLayer):
    """
    Appends the last observations and actions to observations, the latest first; zeros before an
    episode. Actions are those that the policy chose here: outside other layers, the raw ones.

    :param env: observes a Box with one axis, takes a bounded one
    :param n_observations: observations before the present one
    :param n_actions: actions before the one that is to be chosen
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
        arguments = {"n_observations": n_observations, "n_actions": n_actions, "store": store}
        transform = History(n_observations=n_observations, n_actions=n_actions)
        super().__init__(env, transform, store, arguments)
