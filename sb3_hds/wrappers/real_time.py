"""A control loop in real time, with a watchdog for late commands."""

import math
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from sb3_hds.errors import ParameterError, SafetyError

# The histogram of latencies has this many bins per period, over this many periods.
_BINS, _PERIODS = 20, 2
# The least time between two looks of a watchdog that has nothing to do, as a share of the period.
_LEAST_PAUSE = 0.1


class Timing(NamedTuple):
    """
    Counters since the environment was wrapped.

    :param steps: commands of the learner that were executed
    :param overruns: of them, those that came after their deadline
    :param safe_actions: commands of the watchdog
    :param slow_steps: steps of the environment, of either kind, that took longer than a period
    :param dropped: commands that came after the episode had ended under the watchdog
    """

    steps: int = 0
    overruns: int = 0
    safe_actions: int = 0
    slow_steps: int = 0
    dropped: int = 0


class RealTime(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    r"""
    One command per period :math:`T`, at the ticks of a monotonic clock. ``step`` waits for the next
    tick, executes the command and returns what is then observed; the learner has until the
    following tick to answer.

    A command that comes after its tick is an overrun: it is executed at once. With a
    ``safe_action``, a watchdog executes that one if no command has come ``grace`` after a tick, and
    again at each tick until one comes. Then the reward of ``step`` includes the missed steps, and
    ``info["missed_steps"]`` is how many safe actions were executed since the last observation that
    the learner saw. An episode that ends meanwhile is reported by the next ``step``, whose command
    is dropped (``info["command_dropped"]``).

    The first command after a reset begins the ticks, so none passes between the end of an episode
    and that command: train there (``train_freq=(1, "episode")``; vectorised environments reset
    first), or beside the loop with :class:`sb3_hds.algos.TrainBeside`. Where ``step`` is
    interrupted or raises, the watchdog goes on with the safe action until ``reset`` or ``close``.

    A general-purpose operating system wakes a process late, on a busy machine by milliseconds: this
    is not hard real time, and no substitute for a watchdog in the drive.

    Times are no part of ``info``, which is a function of seed and actions: they are attributes,
    ``timing``, ``latency`` (of the latest command, from observation to command [s]; 0 for the first
    of an episode, which is on time whenever it comes), ``overrun`` (whether that came late) and
    :meth:`latencies`.

    :param env: of any kind; simulated ones wait for the clock, real ones must return promptly
    :param period: :math:`T` [s]
    :param safe_action: what the watchdog executes; None: there is no watchdog
    :param grace: how late a command may be before the watchdog acts, as a share of the period
    :param threaded: whether the watchdog has a thread of its own; without, call :meth:`watch`
    :param clock: monotonic [s]
    :param sleep: waits for so many seconds
    :raises ParameterError: for a period or a grace out of range, or an action out of the space
    """

    def __init__(
        self,
        env: gymnasium.Env,
        period: float,
        safe_action: Sequence[float] | np.ndarray | None = None,
        *,
        grace: float = 0.5,
        threaded: bool = True,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(
            self, period=period, safe_action=safe_action, grace=grace, threaded=threaded
        )
        gymnasium.Wrapper.__init__(self, env)
        if not 0.0 < period < math.inf:
            raise ParameterError(f"RealTime(period={period!r}): period must be above 0 s.")
        if not 0.0 <= grace <= 1.0:
            raise ParameterError(f"RealTime(grace={grace!r}): grace must be from 0 to 1.")
        self.period, self.grace = float(period), float(grace)
        self._safe = None if safe_action is None else _in_space(env, safe_action)
        self._threaded = threaded and self._safe is not None
        self._clock, self._sleep = clock, sleep
        self.timing, self.latency, self.overrun = Timing(), 0.0, False
        self._counts = np.zeros(_BINS * _PERIODS + 1, int)
        self._deadline, self._answered = 0.0, 0.0
        self._begun, self._running, self._claimed = False, False, False
        self._missed: list[tuple[Any, Any, bool, bool, dict[str, Any]]] = []
        self._begin_watching()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        with self._lock:
            self._begun, self._running, self._failure = False, False, None
            self._missed.clear()
            return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """
        :return: as the environment; see above for rewards and ``info``
        :raises SafetyError: if the environment failed under the watchdog since the last step
        """
        came = self._clock()
        if self._failure is not None:
            raise SafetyError(
                "The watchdog could not execute the safe action; nothing was executed since. Stop "
                "the robot by hand, then reset."
            ) from self._failure
        if self._begun:
            self.latency = came - self._answered
            self._note(self.latency)
            self.watch()
        else:
            self._begin(came)
        with self._lock:
            missed, self._missed = self._missed, []
            if missed and (missed[-1][2] or missed[-1][3]):
                self.overrun = True
                self.timing = self.timing._replace(dropped=self.timing.dropped + 1)
                return self._merged(missed, dropped=True)
            self._claimed = True
        self.overrun = bool(missed) or came > self._deadline
        try:
            if (wait := self._deadline - self._clock()) > 0.0:
                self._sleep(wait)
            with self._lock:
                result = self._execute(action)
                self._answered = self._clock()
                self.timing = self.timing._replace(
                    steps=self.timing.steps + 1,
                    overruns=self.timing.overruns + int(self.overrun),
                )
        except BaseException:
            with self._lock:
                self._missed = missed + self._missed
            raise
        finally:
            self._claimed = False
        return self._merged([*missed, result], dropped=False)

    def _begin(self, now: float) -> None:
        with self._lock:
            self._deadline, self.latency = now, 0.0
            self._begun, self._running = True, True
        self._watch_on()

    def watch(self) -> bool:
        """
        Execute the safe action if it is due: what the watchdog's thread does at each tick.

        :return: whether it was
        """
        with self._lock:
            due = self._deadline + self.grace * self.period
            if self._safe is None or not self._running or self._claimed or self._clock() < due:
                return False
            self._missed.append(self._execute(self._safe))
            self.timing = self.timing._replace(safe_actions=self.timing.safe_actions + 1)
            return True

    def latencies(self) -> tuple[np.ndarray, np.ndarray]:
        """
        The histogram of times from observation to command.

        :return: counts, shape ``(n,)``, and edges [s], shape ``(n + 1,)``; the last bin is open
        """
        edges = np.linspace(0.0, _PERIODS * self.period, _BINS * _PERIODS + 1)
        return self._counts.copy(), np.append(edges, math.inf)

    def close(self) -> None:
        self._stopped.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        super().close()

    def _execute(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment, and set the next deadline on the grid of ticks."""
        begin = self._clock()
        result = self.env.step(action)
        end = self._clock()
        if end - begin > self.period:
            self.timing = self.timing._replace(slow_steps=self.timing.slow_steps + 1)
        if self._safe is None:  # nobody kept the ticks: begin a grid anew where one was missed
            self._deadline = max(self._deadline, begin)
        passed = math.floor((end - self._deadline) / self.period + 1e-9)
        self._deadline += self.period * (1 + max(0, passed))
        self._running = not (result[2] or result[3])
        return result

    def _merged(
        self,
        results: list[tuple[Any, Any, bool, bool, dict[str, Any]]],
        dropped: bool,
    ) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        obs, _, terminated, truncated, info = results[-1]
        info = info | {
            "missed_steps": len(results) - (not dropped),
            "command_dropped": dropped,
        }
        return obs, sum(float(result[1]) for result in results), terminated, truncated, info

    def _note(self, latency: float) -> None:
        place = int(latency / self.period * _BINS)
        self._counts[min(max(place, 0), len(self._counts) - 1)] += 1

    def _begin_watching(self) -> None:
        self._lock, self._stopped = threading.RLock(), threading.Event()
        self._failure: Exception | None = None
        self._thread: threading.Thread | None = None

    def _watch_on(self) -> None:
        if self._threaded and self._thread is None:
            self._stopped.clear()
            self._thread = threading.Thread(target=self._keep_watching, daemon=True)
            self._thread.start()

    def _keep_watching(self) -> None:
        while not self._stopped.is_set():
            due = self._deadline + self.grace * self.period - self._clock()
            idle = not self._running or self._claimed
            if idle or due > 0.0:
                pause = max(self.grace, _LEAST_PAUSE) * self.period
                self._stopped.wait(pause if idle else due)
                continue
            try:
                self.watch()
            except Exception as error:
                self._running, self._failure = False, error

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_lock": None, "_stopped": None, "_thread": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._begin_watching()
        self._begun, self._running = False, False


def _in_space(env: gymnasium.Env, action: Sequence[float] | np.ndarray) -> np.ndarray:
    found = np.asarray(action, env.action_space.dtype)
    if not env.action_space.contains(found):
        raise ParameterError(
            f"RealTime(safe_action={action!r}): the safe action must be in {env.action_space}."
        )
    return found
