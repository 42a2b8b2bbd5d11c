"""A history of observations and actions."""

import dataclasses
from typing import ClassVar

import numpy as np

from sb3_hds.core.declarations import Actuator, Channel
from sb3_hds.core.transforms.base import (
    InnerAction,
    InnerObs,
    OuterAction,
    Recalled,
    Signals,
    StatefulTransform,
    namespace,
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class History(StatefulTransform):
    """
    Appends the last observations and actions, the latest first; zeros before an episode.

    :param n_observations: observations before the present one
    :param n_actions: actions before the one that is to be chosen
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

    def start(self, obs: InnerObs, below: Signals) -> Recalled:
        return namespace(obs).zeros(len(self.remembers(below)), dtype=obs.dtype)

    def act(
        self, action: OuterAction, obs: InnerObs, memory: Recalled, below: Signals
    ) -> tuple[InnerAction, Recalled]:
        n_seen, n_done = self.n_observations * obs.shape[0], self.n_actions * action.shape[0]
        concatenate = namespace(action).concatenate
        seen = concatenate([obs, memory[:n_seen]])[:n_seen]
        done = concatenate([below.clip(action), memory[n_seen:]])[:n_done]
        return action, concatenate([seen, done])


def _earlier(signals: tuple[Channel, ...] | tuple[Actuator, ...], n: int) -> tuple[Channel, ...]:
    """Channels for what signals were; zeros must fit, too."""
    low, high = (np.array([getattr(s, end) for s in signals]) for end in ("low", "high"))
    ends = zip(np.minimum(low, 0.0).tolist(), np.maximum(high, 0.0).tolist(), strict=True)
    bounds = list(ends)
    return tuple(
        Channel(f"{s.name} {i} ago", s.unit, *bound)
        for i in range(1, n + 1)
        for s, bound in zip(signals, bounds, strict=True)
    )
