"""A penalty on changes of the command."""

import dataclasses
import math
from typing import Any, ClassVar

from sb3_hds.core.signals import Channel
from sb3_hds.core.transforms.base import (
    InnerAction,
    InnerObs,
    OuterAction,
    Recalled,
    Signals,
    StatefulTransform,
    namespace,
    refuse_unless,
)
from sb3_hds.core.transforms.filters import clipped


@dataclasses.dataclass(frozen=True, kw_only=True)
class Continuity(StatefulTransform):
    r"""
    Takes :math:`w\,|a_k - a_{k-1}|^2` off the reward, and leaves actions alone.

    Remembers :math:`a_{k-1}`; before an episode, the command nearest to zero.

    Source: Raffin, Kober and Stulp, *Smooth exploration for robotic reinforcement learning*, CoRL
    2021, section 4.1, where it is a measure.

    :param weight: :math:`w`
    :raises ParameterError: unless it is finite and at least 0
    """

    name: ClassVar[str] = "continuity"

    weight: float

    def __post_init__(self) -> None:
        super().__post_init__()
        refuse_unless(self, "weight", 0.0 <= self.weight < math.inf, "finite and at least 0")

    def remembers(self, below: Signals) -> tuple[Channel, ...]:
        return tuple(Channel(f"last {a.name}", *a[1:]) for a in below.actuators)

    def start(self, obs: InnerObs, below: Signals) -> Recalled:
        return namespace(obs).asarray(below.rest(), dtype=obs.dtype)

    def act(
        self, action: OuterAction, obs: InnerObs, memory: Recalled, below: Signals
    ) -> tuple[InnerAction, Recalled]:
        return action, clipped(action, below)

    def cost(self, action: OuterAction, obs: InnerObs, memory: Recalled, below: Signals) -> Any:
        return self.weight * ((clipped(action, below) - memory) ** 2).sum()
