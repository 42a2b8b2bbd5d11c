"""Commands that arrive late."""

from typing import ClassVar

import gymnasium

from sb3_hds.core import Delay
from sb3_hds.wrappers.action_layer import TransformLayer


class ActionDelay(TransformLayer):
    """
    Commands arrive whole steps late. Those on their way are appended to observations.

    Learners always store what they chose: what is executed in a step was chosen in an earlier one.

    :param env: its actions are a bounded Box with one axis
    :param steps: how late [control intervals]
    :param observe_state: whether the commands on their way are appended, the oldest first; without
        them, the task is not Markov
    :param store: ``"raw"``
    :raises ParameterError: unless ``steps`` is a whole number of at least 1
    """

    stores: ClassVar[tuple[str, ...]] = ("raw",)

    def __init__(
        self, env: gymnasium.Env, steps: int, *, observe_state: bool = True, store: str = "raw"
    ) -> None:
        arguments = {"steps": steps, "observe_state": observe_state, "store": store}
        super().__init__(env, Delay(steps=steps, observed=observe_state), store, arguments)
