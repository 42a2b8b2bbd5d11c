"""
What ``rl_zoo3 train -optimize`` varies.

A sampler suggests plain numbers and names; its converter turns them into hyperparameters. The
sampler returns what the converter makes of ``trial.params``, so that ``--trial-id`` gives a trial
back exactly.
"""

from collections.abc import Callable
from typing import Any

Params = dict[str, Any]

_NET_ARCHS = {"small": [64, 64], "medium": [128, 128], "big": [256, 256]}


def sample_planner_params(
    trial: Any, n_actions: int, n_envs: int, additional_args: Params
) -> Params:
    """
    Sampler of PODS and HDS.

    :param trial: an Optuna trial
    :param n_actions: unused, as are the next two: the zoo calls every sampler with them
    :return: hyperparameters
    """
    trial.suggest_float("one_minus_gamma", 1e-3, 0.1, log=True)
    trial.suggest_float("learning_rate", 1e-4, 1e-2, log=True)
    trial.suggest_int("batch_size_pow", 6, 10)
    trial.suggest_int("n_rollouts_pow", 4, 8)
    trial.suggest_categorical("order", [1, 2])
    trial.suggest_categorical("net_arch", list(_NET_ARCHS))
    trial.suggest_categorical("activation_fn", ["tanh", "relu", "elu"])
    return convert_planner_params(trial.params)


def convert_planner_params(sampled_params: Params) -> Params:
    """
    :param sampled_params: ``trial.params`` of a trial of :func:`sample_planner_params`
    :return: hyperparameters
    """
    params = dict(sampled_params)
    network = {
        "net_arch": list(_NET_ARCHS[params.pop("net_arch")]),
        "activation_fn": params.pop("activation_fn"),
    }
    return {
        "gamma": 1 - params.pop("one_minus_gamma"),
        "batch_size": 2 ** params.pop("batch_size_pow"),
        "n_rollouts": 2 ** params.pop("n_rollouts_pow"),
        "policy_kwargs": network,
        **params,
    }


SAMPLERS: dict[str, Callable[[Any, int, int, Params], Params]] = {
    "pods": sample_planner_params,
    "hds": sample_planner_params,
}
CONVERTERS: dict[str, Callable[[Params], Params]] = {
    "pods": convert_planner_params,
    "hds": convert_planner_params,
}
