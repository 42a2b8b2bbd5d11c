"""Policies of Stable-Baselines3 as modules of torch, from observation to action."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch as th
from gymnasium import spaces

from sb3_hds.deploy.conversion import Port
from sb3_hds.deploy.observations import WHOLE, Normalization, parts_of


class _Deterministic(th.nn.Module):
    """
    :param policy: of Stable-Baselines3
    :param by: normalisation of its observations
    """

    def __init__(self, policy: Any, keys: Sequence[str], by: Mapping[str, Normalization]) -> None:
        super().__init__()
        self.policy, self.keys, self.by = policy, keys, by
        self.space = policy.action_space

    def forward(self, *inputs: th.Tensor) -> th.Tensor:
        """:return: actions in the units of the action space"""
        seen = {key: self._normalized(key, x) for key, x in zip(self.keys, inputs, strict=True)}
        action = self.policy._predict(seen.get(WHOLE, seen), deterministic=True).reshape(
            -1, *self.space.shape
        )
        if not isinstance(self.space, spaces.Box):
            return action
        low, high = th.as_tensor(self.space.low), th.as_tensor(self.space.high)
        if self.policy.squash_output:
            action = low + 0.5 * (action + 1.0) * (high - low)
        return th.clamp(action, low, high)

    def _normalized(self, key: str, values: th.Tensor) -> th.Tensor:
        by = self.by.get(key)
        if by is None:
            return values
        mean, scale = (th.as_tensor(part, dtype=values.dtype) for part in (by.mean, by.scale))
        return th.clamp((values - mean) / scale, -by.clip, by.clip)


def module_of(policy: Any, inputs: Sequence[Port], by: Mapping[str, Normalization]) -> th.nn.Module:
    """
    :param policy: of Stable-Baselines3
    :param inputs: one for each part of an observation
    :param by: normalisation of its observations
    :return: what it computes with ``deterministic=True``, in the units of the action space
    """
    policy.set_training_mode(False)
    assert len(inputs) == len(parts_of(policy.observation_space))
    return _Deterministic(policy, list(parts_of(policy.observation_space)), by)
