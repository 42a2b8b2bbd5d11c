"""A history of observations and actions."""

import dataclasses
from typing import ClassVar

from sb3_hds.core.declarations import Actuator, Channel
from sb3_hds.core.transforms.base import (
    InnerAction,
    InnerObs,
    MemoryVector,
    OuterAction,
    Signals,
    StatefulTransform,
    namespace,
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class History(StatefulTransform):
    """
    Appends the last observations and actions, the latest first; zeros before an episode.

    :param n_observations: number of earlier observations
    :param n_actions: number of earlier actions
    :raises ParameterError: unless both are whole numbers of at least 0, and one is positive
    """

    name: ClassVar[str] = "history"

    n_observations: int
    n_actions: int

    def __post_init__(self) -> None:
        super().__post_init__()
        for field in ("n_observations", "n_actions"):
            value = getattr(self, field)
            whole = isinstance(value, int) and value >= 0
            self.refuse_unless(field, whole, "a whole number of at least 0")
        self.refuse_unless("n_actions", self.n_observations + self.n_actions > 0, "positive")
        self.refuse_unless("observed", self.observed, "True: seeing it is all that it is for")

    def remembers(self, below: Signals) -> tuple[Channel, ...]:
        return _earlier(below.channels, self.n_observations) + _earlier(
            below.actuators, self.n_actions
        )

    def start(self, obs: InnerObs, below: Signals) -> MemoryVector:
        return namespace(obs).zeros(len(self.remembers(below)), dtype=obs.dtype)

    def act(
        self, action: OuterAction, obs: InnerObs, memory: MemoryVector, below: Signals
    ) -> tuple[InnerAction, MemoryVector]:
        n_seen, n_done = self.n_observations * obs.shape[0], self.n_actions * action.shape[0]
        concatenate = namespace(action).concatenate
        seen = concatenate([obs, memory[:n_seen]])[:n_seen]
        done = concatenate([below.clip(action), memory[n_seen:]])[:n_done]
        return action, concatenate([seen, done])


def _earlier(signals: tuple[Channel, ...] | tuple[Actuator, ...], n: int) -> tuple[Channel, ...]:
    """Channels for the last ``n`` values of signals; their limits include the initial zeros."""
    return tuple(
        Channel(f"{s.name} {i} ago", s.unit, float(min(s.low, 0.0)), float(max(s.high, 0.0)))
        for i in range(1, n + 1)
        for s in signals
    )
