"""A penalty on jumps of the action."""

from typing import Any, ClassVar

import gymnasium

from sb3_hds.core import Continuity
from sb3_hds.wrappers.action_layer import TransformLayer


class ContinuityCost(TransformLayer):
    """
    Subtracts ``weight`` times the squared change of the action from the reward. Actions pass
    unchanged; the last one is appended to observations, so that the task stays Markov.

    ``info["continuity_cost"]`` is the penalty.

    :param env: its actions are a bounded Box with one axis
    :param weight: [reward / command unit squared], at least 0
    :param observe_state: whether the last action is appended; without it, the task is not Markov
    :param store: as in the other layers
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
        arguments = {"weight": weight, "observe_state": observe_state, "store": store}
        transform = Continuity(weight=float(weight), observed=observe_state)
        super().__init__(env, transform, store, arguments)

    def extra_info(self) -> dict[str, Any]:
        return {"continuity_cost": self.charged()}
