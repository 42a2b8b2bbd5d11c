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


def _suggest_usual(trial: Any) -> None:
    trial.suggest_float("one_minus_gamma", 1e-3, 0.1, log=True)
    trial.suggest_float("learning_rate", 1e-5, 2e-3, log=True)
    trial.suggest_int("batch_size_pow", 5, 9)
    trial.suggest_int("learning_starts", 100, 10_000, log=True)
    trial.suggest_categorical("net_arch", list(_NET_ARCHS))


def sample_model_free_params(
    trial: Any, n_actions: int, n_envs: int, additional_args: Params
) -> Params:
    """
    Sampler of what all model-free algorithms share.

    :param trial: an Optuna trial
    :param n_actions: unused, as are the next two: the zoo calls every sampler with them
    :return: hyperparameters
    """
    _suggest_usual(trial)
    trial.suggest_int("gradient_steps_pow", 0, 4)
    trial.suggest_categorical("policy_delay", [1, 2, 3, 10, 20])
    return convert_model_free_params(trial.params)


def convert_model_free_params(sampled_params: Params) -> Params:
    """
    :param sampled_params: ``trial.params`` of a trial of :func:`sample_model_free_params`
    :return: hyperparameters
    """
    params = dict(sampled_params)
    updates = {}
    if "gradient_steps_pow" in params:
        updates["gradient_steps"] = 2 ** params.pop("gradient_steps_pow")
    return {
        "gamma": 1 - params.pop("one_minus_gamma"),
        "batch_size": 2 ** params.pop("batch_size_pow"),
        "policy_kwargs": {"net_arch": list(_NET_ARCHS[params.pop("net_arch")])},
        **updates,
        **params,
    }


def _of_policy(name: str, sampled_params: Params) -> Params:
    """One of them is an argument of the policy."""
    others = dict(sampled_params)
    value = others.pop(name)
    params = convert_model_free_params(others)
    params["policy_kwargs"][name] = value
    return params


def sample_soft_params(trial: Any, n_actions: int, n_envs: int, additional_args: Params) -> Params:
    """Sampler of the SAC family: also how fast target networks follow."""
    trial.suggest_float("tau", 1e-3, 0.08, log=True)
    return sample_model_free_params(trial, n_actions, n_envs, additional_args)


def sample_tqc_params(trial: Any, n_actions: int, n_envs: int, additional_args: Params) -> Params:
    """Sampler of TQC: also how many quantiles there are, and how many of them are left out."""
    n_quantiles = trial.suggest_int("n_quantiles", 5, 50)
    trial.suggest_int("top_quantiles_to_drop_per_net", 0, n_quantiles - 1)
    trial.suggest_float("tau", 1e-3, 0.08, log=True)
    sample_model_free_params(trial, n_actions, n_envs, additional_args)
    return convert_tqc_params(trial.params)


def convert_tqc_params(sampled_params: Params) -> Params:
    """
    :param sampled_params: ``trial.params`` of a trial of :func:`sample_tqc_params`
    :return: hyperparameters
    """
    return _of_policy("n_quantiles", sampled_params)


def sample_td7_params(trial: Any, n_actions: int, n_envs: int, additional_args: Params) -> Params:
    """
    Sampler of TD7: also how often its copies move, and how much it explores. In one environment,
    it updates as often as it has acted, so that the number of updates is nothing to suggest.

    :param trial: an Optuna trial
    :param n_actions: unused, as is the last: the zoo calls every sampler with them
    :param n_envs: copies of the environment
    :return: hyperparameters
    """
    trial.suggest_categorical("target_update_interval", [100, 250, 500])
    trial.suggest_float("exploration_noise", 0.05, 0.4, log=True)
    _suggest_usual(trial)
    if n_envs > 1:
        trial.suggest_int("gradient_steps_pow", 0, 4)
    trial.suggest_categorical("policy_delay", [1, 2, 3])
    return convert_model_free_params(trial.params)


def sample_gsde_params(trial: Any, n_actions: int, n_envs: int, additional_args: Params) -> Params:
    """Sampler of gSDE-SAC: also when the noise matrix is drawn, and where its size starts."""
    trial.suggest_categorical("train_freq", [4, 8, 16, 64])
    trial.suggest_float("log_std_init", -4.0, 0.0)
    trial.suggest_float("tau", 1e-3, 0.08, log=True)
    _suggest_usual(trial)
    trial.suggest_int("gradient_steps_pow", 0, 6)
    return convert_gsde_params(trial.params)


def convert_gsde_params(sampled_params: Params) -> Params:
    """
    :param sampled_params: ``trial.params`` of a trial of :func:`sample_gsde_params`
    :return: hyperparameters
    """
    return _of_policy("log_std_init", sampled_params)


def sample_open_loop_params(
    trial: Any, n_actions: int, n_envs: int, additional_args: Params
) -> Params:
    """
    Sampler of OpenLoop: its ranges, gains, and how candidates are judged.

    :param trial: an Optuna trial
    :param n_actions: unused, as are the next two: the zoo calls every sampler with them
    :return: hyperparameters
    """
    trial.suggest_categorical("horizon", [100, 200, 400, 0])
    trial.suggest_int("n_resets", 1, 4)
    trial.suggest_int("population_pow", 3, 5)
    trial.suggest_float("initial_sigma", 0.3, 2.0, log=True)
    trial.suggest_float("kp", 0.5, 20.0, log=True)
    trial.suggest_float("kd_share", 0.01, 0.2, log=True)
    trial.suggest_categorical("gain_factor", [1.0, 4.5])
    trial.suggest_float("amplitude", 0.3, 2.0, log=True)
    trial.suggest_float("offset", 0.1, 1.0)
    trial.suggest_float("lowest_frequency", 0.1, 1.0, log=True)
    trial.suggest_float("frequency_ratio", 3.0, 20.0, log=True)
    return convert_open_loop_params(trial.params)


def convert_open_loop_params(sampled_params: Params) -> Params:
    """
    :param sampled_params: ``trial.params`` of a trial of :func:`sample_open_loop_params`
    :return: hyperparameters
    """
    params = dict(sampled_params)
    lowest = params.pop("lowest_frequency")
    return {
        "horizon": params.pop("horizon") or None,
        "population_size": 2 ** params.pop("population_pow"),
        "kd": params["kp"] * params.pop("kd_share"),
        "frequency": [lowest, lowest * params.pop("frequency_ratio")],
        **params,
    }


_SOFT = ("droq", "simba", "bro")

SAMPLERS: dict[str, Callable[[Any, int, int, Params], Params]] = {
    "pods": sample_planner_params,
    "hds": sample_planner_params,
    "gsde_sac": sample_gsde_params,
    "crossq_jax": sample_model_free_params,
    "tqc_jax": sample_tqc_params,
    "td7": sample_td7_params,
    "openloop": sample_open_loop_params,
    **dict.fromkeys(_SOFT, sample_soft_params),
}
CONVERTERS: dict[str, Callable[[Params], Params]] = {
    "pods": convert_planner_params,
    "hds": convert_planner_params,
    "gsde_sac": convert_gsde_params,
    "crossq_jax": convert_model_free_params,
    "tqc_jax": convert_tqc_params,
    "td7": convert_model_free_params,
    "openloop": convert_open_loop_params,
    **dict.fromkeys(_SOFT, convert_model_free_params),
}
