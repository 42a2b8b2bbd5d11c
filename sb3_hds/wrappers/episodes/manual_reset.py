"""Ends of episodes at the request of an operator."""

import threading
from collections.abc import Callable
from typing import Any

import gymnasium

from sb3_hds.wrappers.by_name import function_of


class ManualReset(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    """
    Ends an episode when asked to: with a key, a foot switch, or from another thread.

    The step during which the request comes is truncated, not terminated, because the task is not
    over. Observations, actions and rewards are
    left alone.

    :param env: of any kind
    :param wanted: asked after every step whether to end, or its name ``"package.module.function"``;
        default: only :meth:`request` ends. In ``env.spec``, a name is remembered and a function is
        not: it may be one that no other process has.
    :raises ParameterError: if there is no function of that name
    """

    def __init__(self, env: gymnasium.Env, wanted: Callable[[], bool] | str | None = None) -> None:
        name = wanted if isinstance(wanted, str) else None
        gymnasium.utils.RecordConstructorArgs.__init__(self, wanted=name)
        gymnasium.Wrapper.__init__(self, env)
        self._wanted = function_of(wanted) if isinstance(wanted, str) else wanted
        self._requested = threading.Event()

    def request(self) -> None:
        """End the episode with the step that is running, or the next one. Any thread may call."""
        self._requested.set()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        self._requested.clear()
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """:return: as the environment, with ``info["manual_reset"]`` where it was asked to end"""
        obs, reward, terminated, truncated, info = self.env.step(action)
        if self._requested.is_set() or (self._wanted is not None and self._wanted()):
            self._requested.clear()
            return obs, reward, terminated, True, info | {"manual_reset": True}
        return obs, reward, terminated, truncated, info

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_requested": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._requested = threading.Event()
