"""Run a policy file in an environment in real time, and record it."""

import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces

from sb3_hds.deploy.onnx_policy import OnnxPolicy
from sb3_hds.errors import ExportError
from sb3_hds.wrappers.real_time import RealTime, Timing
from sb3_hds.wrappers.record import Record

# Width of the bars of the histogram.
_WIDTH = 40


class Latencies(NamedTuple):
    """
    Latencies and returns of a run.

    :param period: control interval [s]
    :param inference: time of the policy alone, one per step [s]
    :param counts: histogram of the times from observation to command, without the first of each
        episode
    :param edges: of its bins [s], one more than counts; the last is infinite
    :param timing: counts of late steps
    :param returns: of the episodes
    """

    period: float
    inference: np.ndarray
    counts: np.ndarray
    edges: np.ndarray
    timing: Timing
    returns: tuple[float, ...]

    def __str__(self) -> str:
        micro = 1e6 * self.inference
        lines = [
            f"{self.timing.steps} steps at {1.0 / self.period:g} Hz, "
            f"{self.timing.overruns} of them late; returns: "
            + ", ".join(f"{value:.1f}" for value in self.returns),
            f"inference: median {np.median(micro):.0f} us, 99 % {np.quantile(micro, 0.99):.0f} us, "
            f"worst {micro.max():.0f} us",
            "observation to command:",
        ]
        most = max(int(self.counts.max(initial=0)), 1)
        for i in np.flatnonzero(self.counts):
            low, high = 1e3 * self.edges[i], 1e3 * self.edges[i + 1]
            bar = "#" * max(1, round(_WIDTH * self.counts[i] / most))
            lines.append(f"  {low:8.2f} to {high:8.2f} ms {bar} {self.counts[i]}")
        return "\n".join(lines)


def run_policy(
    policy: OnnxPolicy,
    env: gymnasium.Env,
    *,
    rate: float | None = None,
    n_episodes: int = 1,
    max_steps: int | None = None,
    record: str | os.PathLike[str] | None = None,
    condition: str = "default",
    seed: int | None = None,
    safe_action: Sequence[float] | np.ndarray | None = None,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> Latencies:
    """
    Run a policy in real time, by :class:`~sb3_hds.wrappers.RealTime`.

    Imports neither jax nor torch, unless the environment does.

    :param policy: to run
    :param env: a simulation or a robot; closed at the end
    :param rate: steps per second [Hz]; default: that of the policy
    :param n_episodes: to run
    :param max_steps: in total; None: no limit
    :param record: file of :class:`~sb3_hds.data.Recorder` to write; None: nothing is recorded
    :param condition: label of the recording
    :param seed: of the first reset
    :param safe_action: of the watchdog; None: no watchdog
    :param clock: monotonic [s]
    :param sleep: waits for a time [s]
    :return: latencies and returns
    :raises ExportError: for an environment that does not fit the policy, or an unknown rate
    :raises TrajectoryError: if the recording cannot be written
    """
    _check_fits(policy, env)
    period = _period(policy, rate)
    if record is not None:
        env = Record(
            env,
            record,
            dt=period,
            obs_names=_unique(policy.observation_names),
            action_names=_unique(policy.action_names),
            condition=condition,
        )
    paced = RealTime(env, period, safe_action, clock=clock, sleep=sleep)
    inference: list[float] = []
    returns: list[float] = []
    try:
        while len(returns) < n_episodes and (max_steps is None or len(inference) < max_steps):
            obs, _ = paced.reset(seed=seed)
            seed, state, earned, over = None, None, 0.0, False
            while not over and (max_steps is None or len(inference) < max_steps):
                begin = time.perf_counter()
                action, state = policy.predict(obs, state, joints=_joints(policy, paced))
                inference.append(time.perf_counter() - begin)
                obs, reward, terminated, truncated, _ = paced.step(action)
                earned, over = earned + float(reward), terminated or truncated
            returns.append(earned)
    finally:
        counts, edges = paced.latencies()
        paced.close()
    return Latencies(period, np.array(inference), counts, edges, paced.timing, tuple(returns))


def _period(policy: OnnxPolicy, rate: float | None) -> float:
    if rate is not None:
        if not (np.isfinite(rate) and rate > 0.0):
            raise ExportError(f"rate must be a number of steps per second above 0, got {rate!r}.")
        return 1.0 / rate
    if policy.dt is None:
        raise ExportError(
            "The file does not contain the control interval of its policy. Pass the rate [Hz]: "
            "run_policy(..., rate=50), or --rate 50."
        )
    return policy.dt


def _check_fits(policy: OnnxPolicy, env: gymnasium.Env) -> None:
    wanted = sum(map(len, policy.metadata["observations"].values()))
    parts = env.observation_space
    parts = list(parts.spaces.values()) if isinstance(parts, spaces.Dict) else [parts]
    found = sum(int(np.prod(part.shape or ())) for part in parts)
    actions = int(np.prod(env.action_space.shape or ()))
    if (wanted, len(policy.action_names)) != (found, actions):
        outside = policy.metadata["outside"]
        hint = f" Wrap it as in the training: {', '.join(outside)}." if outside else ""
        raise ExportError(
            f"The policy takes {wanted} observed numbers and returns {len(policy.action_names)} "
            f"commands; the environment has {found} and {actions}.{hint}"
        )


def _joints(policy: OnnxPolicy, env: gymnasium.Env) -> tuple[np.ndarray, np.ndarray] | None:
    places = policy.joints
    if places is None:
        return None
    inner: Any = env.unwrapped
    if not hasattr(inner, "state_vector"):
        raise ExportError(
            "The policy reads joints in addition to the observation, by state_vector() of "
            "Gymnasium's MuJoCo environments, which this one does not have. Call "
            "OnnxPolicy.predict(obs, state, joints=(positions, velocities)) in your own loop."
        )
    state = np.asarray(inner.state_vector())
    position, velocity = places
    return state[position], state[velocity]


def _unique(names: Sequence[str]) -> list[str]:
    """Make names unique, as a recording needs them; those of a Dict may repeat."""
    seen: Counter[str] = Counter()
    found = []
    for name in names:
        seen[name] += 1
        found.append(name if seen[name] == 1 else f"{name}#{seen[name]}")
    return found
