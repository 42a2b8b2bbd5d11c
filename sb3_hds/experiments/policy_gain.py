"""The policy gain of a diagnosis: return on the real system after training in each twin."""

import dataclasses
import inspect
import os
import textwrap
from collections.abc import Callable, Mapping
from numbers import Integral
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.wrappers import TimeLimit
from jaxtyping import Float
from rich.progress import track
from scipy.stats import trim_mean
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_hds.algos import HDS
from sb3_hds.algos.twin.algorithm import TwinAlgorithm
from sb3_hds.core import Twin
from sb3_hds.core.trajectories.storage import write_bytes
from sb3_hds.envs import TwinEnv, true_twin
from sb3_hds.errors import EnvironmentMismatchError, ParameterError, TrajectoryError
from sb3_hds.experiments.returns import returns_of
from sb3_hds.sysid import Diagnosis
from sb3_hds.sysid.reporting.figures import as_png, plot_policy_gain
from sb3_hds.sysid.reporting.wording import policy_in_words
from sb3_hds.wrappers.episodes import step_limit_of

_N_RESAMPLES = 2000
_LEVEL = 0.9


@dataclasses.dataclass(frozen=True)
class Return:
    """
    :param mean: interquartile mean over runs and episodes
    :param low: lower end of its 90 % interval, by bootstrap over runs; None for a single run
    :param high: upper end of the interval
    """

    mean: float
    low: float | None
    high: float | None


@dataclasses.dataclass(frozen=True, repr=False)
class PolicyGain:
    """
    Return on the real system of policies that were trained in simulations. Prints itself.

    :param returns: by simulation (``"believed"`` for the nominal twin, ``"extended"``, and
        ``"true"`` if known): one row per run, one column per initial state, shape
        ``(runs, episodes)``
    :param gain: of the extended over the nominal twin, paired by run and initial state
    """

    returns: Mapping[str, Float[np.ndarray, "runs episodes"]]
    gain: Return

    def of(self, simulation: str) -> Return:
        """:return: interquartile mean of the policies from one simulation, with its interval"""
        return _summarised(self.returns[simulation])

    @property
    def share_of_ceiling(self) -> float | None:
        """
        Share of the gap to policies from the true twin that was closed; None if that twin is
        unknown, or there is no gap.
        """
        if "true" not in self.returns:
            return None
        nominal, extended, true = (self.of(s).mean for s in ("believed", "extended", "true"))
        return (extended - nominal) / (true - nominal) if true > nominal else None

    def to_dict(self) -> dict[str, Any]:
        """:return: numbers as plain data for JSON"""
        return {
            "simulations": {s: dataclasses.asdict(self.of(s)) for s in self.returns},
            "gain": dataclasses.asdict(self.gain),
            "share_of_ceiling": self.share_of_ceiling,
            "runs": len(self.returns["believed"]),
            "episodes": self.returns["believed"].shape[1],
            "returns": {s: values.tolist() for s, values in self.returns.items()},
        }

    def plot(self, path: str | os.PathLike[str]) -> Path:
        """
        Plot the returns: one dot per run (with a single run, per initial state), lines at the
        interquartile means, and bars for their intervals.

        :param path: of the picture
        :raises ImportError: without matplotlib (extra ``report``)
        """
        return write_bytes(path, as_png(plot_policy_gain(self.to_dict())))

    def __str__(self) -> str:
        words = policy_in_words(self.to_dict())
        lines = textwrap.wrap(f"{words.measured}:", 80)
        for name, value, *interval in (words.columns, *words.rows):
            lines.append(f"  {name:<22} {value:>9}   {''.join(interval)}".rstrip())
        for note in words.notes:
            lines += textwrap.wrap(note, 80)
        return "\n".join(lines)

    __repr__ = __str__


def measure_policy_gain(
    diagnosis: Diagnosis,
    env: gymnasium.Env | str | Callable[[], gymnasium.Env],
    algorithm: type[BaseAlgorithm] = HDS,
    *,
    budget: int = 0,
    seeds: int = 5,
    n_episodes: int = 20,
    ceiling: bool | Twin = True,
    progress: bool = True,
    **arguments: Any,
) -> PolicyGain:
    """
    Train with the same budget in the nominal and in the extended twin, and measure returns on the
    real system.

    Runs with the same seed differ in the twin only, and all start from the same initial states. If
    ``env`` is one of our stand-ins for hardware, or a :class:`~sb3_hds.envs.TwinEnv`, policies from
    its true twin are the ceiling.

    :param diagnosis: whose ``believed`` and extended ``twin`` are compared
    :param env: the real system, its id, or a function that makes it; without a step limit, that of
        the nominal twin is applied
    :param algorithm: trained in the simulations only
    :param budget: training steps per policy; 0 suffices for PODS and HDS, which plan in their twin
        before the first step
    :param seeds: runs per simulation
    :param n_episodes: number of initial states on the real system
    :param ceiling: whether to train in the true twin, too, if it is known; or that twin
    :param progress: whether to show a progress bar
    :param arguments: of the algorithm
    :return: returns by simulation, and the gain with its interval
    :raises TrajectoryError: for a twin without a task, fewer than one run or episode, or an
        algorithm that learns nothing within the budget
    :raises ParameterError: for an unknown argument of the algorithm
    :raises EnvironmentMismatchError: if the real system has other observations or actions
    """
    made = _made(env)
    check_question(diagnosis.believed, made, algorithm, budget, seeds, n_episodes, arguments)
    real = made
    if step_limit_of(made) is None:
        real = TimeLimit(made, diagnosis.believed.max_episode_steps)  # type: ignore[arg-type]
    simulations = {"believed": diagnosis.believed, "extended": diagnosis.twin}
    if (true := _true_twin(real, ceiling)) is not None:
        simulations["true"] = true
    runs = [(name, seed) for seed in range(seeds) for name in simulations]
    returns: dict[str, list[np.ndarray]] = {name: [] for name in simulations}
    for name, seed in track(runs, "training", transient=True, disable=not progress):
        model = algorithm("MlpPolicy", _task(simulations[name]), seed=seed, **arguments)
        model.learn(budget)
        returns[name].append(returns_of(model, real, n_episodes))
    if made is not env:
        made.close()
    found = {name: np.stack(rows) for name, rows in returns.items()}
    return PolicyGain(found, _summarised(found["extended"] - found["believed"]))


def check_question(
    nominal: Twin,
    real: gymnasium.Env,
    algorithm: type[BaseAlgorithm],
    budget: int,
    seeds: int,
    n_episodes: int,
    arguments: Mapping[str, Any],
) -> None:
    """
    The checks of :func:`measure_policy_gain` that need no diagnosis.

    :param nominal: the nominal twin
    :param arguments: of the algorithm
    :raises TrajectoryError: as there
    :raises ParameterError: as there
    :raises EnvironmentMismatchError: as there
    """
    counts = (seeds, n_episodes, budget)
    if not all(isinstance(n, Integral) for n in counts) or min(counts) < 0 or 0 in counts[:2]:
        raise TrajectoryError(
            "seeds and n_episodes must be whole numbers of at least 1 and budget one of at least "
            f"0, got seeds={seeds}, n_episodes={n_episodes}, budget={budget}."
        )
    try:
        inspect.signature(algorithm).bind_partial("MlpPolicy", real, seed=0, **arguments)
    except TypeError as error:
        raise ParameterError(f"{algorithm.__name__} cannot be made: {error}.") from None
    plans = issubclass(algorithm, TwinAlgorithm) and arguments.get("pretrain_epochs", 1) > 0
    if budget == 0 and not plans:
        raise TrajectoryError(
            f"{algorithm.__name__} learns nothing in 0 steps: give it a budget, for example "
            "10,000 steps."
        )
    if nominal.max_episode_steps is None:
        raise TrajectoryError(
            f"{nominal.name} has no episode length, so there is no task to train for. "
            "Give its class max_episode_steps and a reward."
        )
    _check_same_signals(real, nominal)


def _made(env: gymnasium.Env | str | Callable[[], gymnasium.Env]) -> gymnasium.Env:
    if isinstance(env, str):
        return gymnasium.make(env)
    made = env() if callable(env) else env
    if not isinstance(made, gymnasium.Env):
        raise ParameterError(
            "env is the real system, its id, or a function that makes it: one gymnasium.Env, got "
            f"{type(made).__name__}."
        )
    return made


def _check_same_signals(real: gymnasium.Env, nominal: Twin) -> None:
    simulated = TwinEnv(nominal)
    ours, theirs = simulated.observation_space.shape, real.observation_space.shape
    if ours != theirs:
        raise EnvironmentMismatchError(
            f"The real system has observations of shape {theirs}, {nominal.name} of shape {ours}. "
            "A policy of one cannot act on the other: wrap the system so that its observations "
            "are those of the twin."
        )
    ours, theirs = simulated.action_space, real.action_space
    if not (
        isinstance(theirs, gymnasium.spaces.Box)
        and theirs.shape == ours.shape
        and np.allclose([theirs.low, theirs.high], [ours.low, ours.high])
    ):
        shown = "no Box" if not isinstance(theirs, gymnasium.spaces.Box) else _range(theirs)
        raise EnvironmentMismatchError(
            f"The real system takes actions in {shown}, {nominal.name} in {_range(ours)}. Wrap "
            "the system so that actions mean the same."
        )


def _range(space: gymnasium.spaces.Box) -> str:
    low, high = ("[" + ", ".join(f"{x:g}" for x in end) + "]" for end in (space.low, space.high))
    return f"{low} to {high}"


def _true_twin(real: gymnasium.Env, ceiling: bool | Twin) -> Twin | None:
    """The twin of the real system; None if it is unknown or no ceiling is wanted."""
    if isinstance(ceiling, Twin):
        return ceiling
    if not ceiling:
        return None
    if isinstance(real.unwrapped, TwinEnv):
        return real.unwrapped.twin
    try:
        return true_twin(real)
    except TypeError:
        return None


def _task(twin: Twin) -> gymnasium.Env:
    assert twin.max_episode_steps is not None
    return TimeLimit(TwinEnv(twin), twin.max_episode_steps)


def _summarised(values: Float[np.ndarray, "runs episodes"]) -> Return:
    """Interquartile mean, with its bootstrap interval over runs if there are several."""
    n = len(values)
    if n == 1:
        return Return(float(_interquartile_means(values[None])[0]), None, None)
    drawn = values[np.random.default_rng(0).integers(n, size=(_N_RESAMPLES, n))]
    means = _interquartile_means(np.concatenate([values[None], drawn]))
    low, high = np.quantile(means[1:], [0.5 - 0.5 * _LEVEL, 0.5 + 0.5 * _LEVEL])
    return Return(float(means[0]), float(low), float(high))


def _interquartile_means(
    values: Float[np.ndarray, "samples runs episodes"],
) -> Float[np.ndarray, " samples"]:
    """Agarwal et al., *Deep RL at the edge of the statistical precipice*, NeurIPS 2021."""
    return trim_mean(values.reshape(len(values), -1), 0.25, axis=1)
