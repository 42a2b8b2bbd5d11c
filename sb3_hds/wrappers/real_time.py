"""A control loop in real time, with a watchdog for late commands."""

import math
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from sb3_hds.errors import ParameterError, SafetyError

# Bins per period of the histogram of latencies, and its range in periods.
_BINS, _PERIODS = 20, 2
# Minimum polling interval of an idle watchdog, as a share of the period.
_MIN_PAUSE = 0.1


class Timing(NamedTuple):
    """
    Counters since the environment was wrapped.

    :param steps: executed commands of the learner
    :param overruns: those of them that missed their deadline
    :param safe_actions: executed commands of the watchdog
    :param slow_steps: steps of the environment, of either kind, that took longer than a period
    :param dropped: commands that arrived after the watchdog had reached the end of the episode
    """

    steps: int = 0
    overruns: int = 0
    safe_actions: int = 0
    slow_steps: int = 0
    dropped: int = 0


class RealTime(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    r"""
    One command per period :math:`T`, at the ticks of a monotonic clock. ``step`` waits for the next
    tick, executes the command and returns the resulting observation; the learner has until the
    following tick to respond.

    A command that arrives after its tick is an overrun, and is executed at once. With a
    ``safe_action``, a watchdog executes that action if no command has arrived ``grace`` after a
    tick, and again at each tick until one arrives. The reward of the next ``step`` then includes
    the missed steps, and ``info["missed_steps"]`` is the number of safe actions since the last
    observation that the learner received. If the episode ends meanwhile, the next ``step`` reports
    it and drops its command (``info["command_dropped"]``).

    Ticks start with the first command after a reset, so no deadline passes between the end of an
    episode and that command: train there (``train_freq=(1, "episode")``; vectorised environments
    reset first), or in parallel with :class:`sb3_hds.algos.TrainBeside`. If ``step`` is interrupted
    or raises, the watchdog continues with the safe action until ``reset`` or ``close``.

    This is not hard real time, and no substitute for a watchdog in the drive: a general-purpose
    operating system may wake a process milliseconds late.

    Times are not in ``info``, which is a function of seed and actions, but in attributes:
    ``timing``, ``latency`` (from observation to the latest command [s]; 0 for the first of an
    episode, which is never late), ``overrun`` (whether that command was late) and
    :meth:`latencies`.

    :param env: of any kind; ``step`` of a real one must return promptly
    :param period: :math:`T` [s]
    :param safe_action: command of the watchdog; None: no watchdog
    :param grace: delay after a tick at which the watchdog acts, as a share of the period
    :param threaded: whether the watchdog runs in its own thread; otherwise, call :meth:`watch`
    :param clock: monotonic [s]
    :param sleep: waits for a time [s]
    :raises ParameterError: for a period or a grace out of range, or an action outside the space
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
        self._deadline, self._observed_at = 0.0, 0.0
        self._begun, self._running, self._claimed = False, False, False
        self._missed: list[tuple[Any, Any, bool, bool, dict[str, Any]]] = []
        self._init_watchdog()

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
        :raises SafetyError: if the watchdog could not step the environment since the last step
        """
        arrival = self._clock()
        if self._failure is not None:
            raise SafetyError(
                "The watchdog could not execute the safe action; nothing was executed since then. "
                "Stop the robot by hand, then reset."
            ) from self._failure
        if self._begun:
            self.latency = arrival - self._observed_at
            self._count(self.latency)
            self.watch()
        else:
            self._begin(arrival)
        with self._lock:
            missed, self._missed = self._missed, []
            if missed and (missed[-1][2] or missed[-1][3]):
                self.overrun = True
                self.timing = self.timing._replace(dropped=self.timing.dropped + 1)
                return self._merged(missed, dropped=True)
            self._claimed = True
        self.overrun = bool(missed) or arrival > self._deadline
        try:
            if (wait := self._deadline - self._clock()) > 0.0:
                self._sleep(wait)
            with self._lock:
                result = self._execute(action)
                self._observed_at = self._clock()
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
        self._start_watchdog()

    def watch(self) -> bool:
        """
        Execute the safe action if it is due, as the watchdog's thread does at each tick.

        :return: whether it was due
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
        Histogram of the times from observation to command.

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
        """Step the environment, and set the deadline to the next tick."""
        begin = self._clock()
        result = self.env.step(action)
        end = self._clock()
        if end - begin > self.period:
            self.timing = self.timing._replace(slow_steps=self.timing.slow_steps + 1)
        if self._safe is None:  # without a watchdog, restart the ticks after a missed one
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

    def _count(self, latency: float) -> None:
        place = int(latency / self.period * _BINS)
        self._counts[min(max(place, 0), len(self._counts) - 1)] += 1

    def _init_watchdog(self) -> None:
        self._lock, self._stopped = threading.RLock(), threading.Event()
        self._failure: Exception | None = None
        self._thread: threading.Thread | None = None

    def _start_watchdog(self) -> None:
        if self._threaded and self._thread is None:
            self._stopped.clear()
            self._thread = threading.Thread(target=self._run_watchdog, daemon=True)
            self._thread.start()

    def _run_watchdog(self) -> None:
        while not self._stopped.is_set():
            due = self._deadline + self.grace * self.period - self._clock()
            idle = not self._running or self._claimed
            if idle or due > 0.0:
                pause = max(self.grace, _MIN_PAUSE) * self.period
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
        self._init_watchdog()
        self._begun, self._running = False, False


def _in_space(env: gymnasium.Env, action: Sequence[float] | np.ndarray) -> np.ndarray:
    found = np.asarray(action, env.action_space.dtype)
    if not env.action_space.contains(found):
        raise ParameterError(
            f"RealTime(safe_action={action!r}): the safe action must be in {env.action_space}."
        )
    return found
