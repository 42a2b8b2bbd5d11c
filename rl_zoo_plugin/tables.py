"""Entries of ``sb3_hds`` in the tables of ``rl_zoo3``."""

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from rl_zoo_plugin import hub, trials
from rl_zoo_plugin.lazy import LazyAlgorithm
from sb3_hds.algos.registry import ALGORITHMS  # registers our environments with Gymnasium, too

_PROGRESS = "rl_zoo_plugin.callbacks.TrialProgress"
_PROGRESS_BAR = "stable_baselines3.common.callbacks.ProgressBarCallback"


def hyperparams_file(algo: str) -> Path:
    """
    :param algo: an id of ``sb3_hds.algos.registry.ALGORITHMS``
    :return: its zoo-format yml file: next to this module in a wheel, in the root of a checkout
    """
    installed, checkout = (folder / "hyperparams" for folder in Path(__file__).parents[:2])
    return (installed if installed.is_dir() else checkout) / f"{algo}.yml"


def _extend_algorithms(utils: ModuleType) -> None:
    for algo, entry in ALGORITHMS.items():
        utils.ALGOS.setdefault(algo, LazyAlgorithm(entry.name))


def _extend_samplers(hyperparams_opt: ModuleType) -> None:
    from rl_zoo_plugin.samplers import SAMPLERS

    for algo, entry in ALGORITHMS.items():
        sampler = SAMPLERS[entry.sampler]
        if hyperparams_opt.HYPERPARAMS_SAMPLER.setdefault(algo, sampler) is sampler:
            hyperparams_opt.HYPERPARAMS_CONVERTER.setdefault(algo, sampler.convert)


def _extend_manager(exp_manager: ModuleType) -> None:
    """Our algorithms read our yml files, unless the user names another file."""
    manager = exp_manager.ExperimentManager
    original = manager.__init__
    signature = inspect.signature(original)

    @functools.wraps(original)
    def init(*args: Any, **kwargs: Any) -> None:
        call = signature.bind(*args, **kwargs)
        algo = call.arguments["algo"]
        is_ours = isinstance(exp_manager.ALGOS.get(algo), LazyAlgorithm)
        if is_ours and not call.arguments.get("config"):
            call.arguments["config"] = str(hyperparams_file(algo))
        original(*call.args, **call.kwargs)

    manager.__init__ = init
    _extend_trials(exp_manager, manager)


def _extend_trials(exp_manager: ModuleType, manager: Any) -> None:
    """
    Trials of our algorithms know their budget of steps and print their progress, may be pruned
    before the first real step, and run again if their process dies.
    """
    optimize, objective = manager.hyperparameters_optimization, manager.objective

    def is_ours(self: Any) -> bool:
        return isinstance(exp_manager.ALGOS.get(self.algo), LazyAlgorithm)

    @functools.wraps(optimize)
    def optimize_with_progress(self: Any) -> None:
        if is_ours(self):
            from rl_zoo_plugin.pruning import TrialEvaluations
            from rl_zoo_plugin.storages import shared

            given = self.specified_callbacks or []
            given = given if isinstance(given, list) else [given]
            bar = self.show_progress and self.n_jobs == 1
            self.specified_callbacks = [*given, _PROGRESS_BAR if bar else _PROGRESS]
            self.storage = shared(self.storage, self.study_name)
            exp_manager.TrialEvalCallback = TrialEvaluations  # type: ignore[attr-defined]
        optimize(self)

    @functools.wraps(objective)
    def objective_with_budget(self: Any, trial: Any) -> float:
        if not is_ours(self):
            return objective(self, trial)
        with trials.running(trial.number, self.n_timesteps):
            return objective(self, trial)

    manager.hyperparameters_optimization, manager.objective = (
        optimize_with_progress,
        objective_with_budget,
    )


EXTENSIONS: dict[str, Callable[[ModuleType], None]] = {
    "rl_zoo3.utils": _extend_algorithms,
    "rl_zoo3.hyperparams_opt": _extend_samplers,
    "rl_zoo3.exp_manager": _extend_manager,
    "huggingface_sb3.push_to_hub": hub.extend_push,
    "huggingface_sb3.load_from_hub": hub.extend_load,
}
"""Module of the zoo or of its libraries to the function that extends it, once, after it has run."""
