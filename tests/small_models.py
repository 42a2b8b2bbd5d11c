"""Every algorithm with small networks and budgets: the tests check that it works, not how well."""

import contextlib
import io
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_hds import algos
from sb3_hds.algos.twin.algorithm import TwinAlgorithm

# One set for all that plan in a twin: equal settings are one compiled program.
_LEARNING = {"batch_size": 16, "buffer_size": 500, "policy_kwargs": {"net_arch": [8]}}
_PLANNING = _LEARNING | {"pretrain_epochs": 1, "n_rollouts": 8, "horizon": 4, "lookahead": 2}
_PLANNING |= {"n_random_plans": 2, "gradient_steps": 4, "train_freq": 25}
_MODEL_FREE = _LEARNING | {"learning_starts": 10, "train_freq": 5, "gradient_steps": 2}
# What an algorithm has besides.
_OWN = {
    "pods": {"n_iterations": 1, "n_step_sizes": 3, "plan_memory": 2},
    "hds": {"residual_kwargs": {"n_members": 2, "net_arch": [4]}},
    "tqc_jax": {"policy_kwargs": {"net_arch": [8], "n_quantiles": 5}},
    "td7": {"use_checkpoints": False, "policy_kwargs": {"net_arch": [8], "embedding_size": 8}},
    "bro": {"policy_kwargs": {"net_arch": [8], "n_quantiles": 5}},
    "openloop": {"population_size": 3, "horizon": 4, "n_elites": 2, "ranking_share": 0.0},
}

NAMES = list(algos.ALL)
#: the algorithms that plan in a twin
PLANNERS = [name for name in NAMES if issubclass(algos.ALL[name], TwinAlgorithm)]
#: the algorithms that learn from a replay buffer, by gradients
OFF_POLICY = [name for name in NAMES if issubclass(algos.ALL[name], OffPolicyAlgorithm)]
MODEL_FREE = [name for name in OFF_POLICY if name not in PLANNERS]
#: arguments of each
SMALL: dict[str, dict[str, Any]] = {
    name: (_PLANNING if name in PLANNERS else _MODEL_FREE if name in MODEL_FREE else {})
    | _OWN.get(name, {})
    for name in NAMES
}

#: observations of Pendulum-v1
STATES = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, -2.0]], np.float32)


#: all; those that share every line with one of these four are among the expensive tests
EVERY_NAME = [
    name
    if name in ("hds", "droq", "td7", "openloop")
    else pytest.param(name, marks=pytest.mark.expensive)
    for name in NAMES
]


def small(name: str, env: Any = "Pendulum-v1", **changes: Any) -> BaseAlgorithm:
    """:return: a model of the algorithm with this id, with seed 0 unless another is given"""
    return algos.ALL[name](env=env, **({"seed": 0} | SMALL[name] | changes))


class Lines(KVWriter):
    """Keeps what is logged: one dictionary for each line."""

    def __init__(self) -> None:
        self.lines: list[dict[str, Any]] = []

    def write(self, key_values, key_excluded, step: int = 0) -> None:
        self.lines.append({"step": step, **key_values})

    def close(self) -> None:
        self.lines = []

    def column(self, key: str) -> list[Any]:
        return [line[key] for line in self.lines if key in line]

    def steps(self, key: str) -> list[int]:
        """:return: where a curve of it has its points"""
        return [line["step"] for line in self.lines if key in line]


def logged(model: BaseAlgorithm) -> Lines:
    """:return: what the model will log from now on"""
    lines = Lines()
    model.set_logger(Logger(folder=None, output_formats=[lines]))
    return lines


@contextlib.contextmanager
def compilations() -> Iterator[Counter[str]]:
    """:return: how often each function is compiled in the block, by its name"""
    counts, listening = Counter(), True

    def count(event: str, _: float, fun_name: str = "", **__) -> None:
        if listening and event.endswith("backend_compile_duration"):
            counts[fun_name.removeprefix("jit(").removesuffix(")")] += 1

    jax.monitoring.register_event_duration_secs_listener(count)
    try:
        yield counts
    finally:
        listening = False


def same(first: dict, second: dict) -> bool:
    """:return: whether two results of ``get_parameters`` are equal"""
    return all(
        th.equal(tensor, second[part][key])
        for part, tensors in first.items()
        for key, tensor in tensors.items()
    )


def saved(model: BaseAlgorithm) -> io.BytesIO:
    """:return: the model's zip file in memory"""
    file = io.BytesIO()
    model.save(file)
    file.seek(0)
    return file


def repacked(model: BaseAlgorithm, part: str, change: Callable[[bytes], bytes]) -> io.BytesIO:
    """:return: the model's zip file, of which one part was changed"""
    old, file = zipfile.ZipFile(saved(model)), io.BytesIO()
    with zipfile.ZipFile(file, "w") as new:
        for name in old.namelist():
            new.writestr(name, change(old.read(name)) if name == part else old.read(name))
    file.seek(0)
    return file


def reloaded(model: BaseAlgorithm, **changes: Any) -> BaseAlgorithm:
    """:return: the model saved and loaded, with an environment unless another is given"""
    return type(model).load(saved(model), **({"env": "Pendulum-v1"} | changes))


def greedy(actor: Any, obs: Any = STATES) -> np.ndarray:
    """:return: what a model, or a policy, does where it explores nothing"""
    return actor.predict(obs, deterministic=True)[0]
