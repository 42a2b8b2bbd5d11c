"""
What ``rl_zoo3 train -optimize`` varies.

A sampler suggests plain numbers and names; its converter turns them into hyperparameters. The
sampler returns what the converter makes of ``trial.params``, so that ``--trial-id`` gives a trial
back exactly. What a file says of ``policy_kwargs`` stays, but for what is varied: the zoo would
replace all of them.
"""

from collections.abc import Callable
from typing import Any

from rl_zoo_plugin import trials
from rl_zoo_plugin.lazy import OF_POLICY

Params = dict[str, Any]

_NET_ARCHS = {"small": [64, 64], "medium": [128, 128], "big": [256, 256]}
# Blocks of SimBa and BRO: one of the actor, two of the critics.
_BLOCKS = {
    "small": {"pi": [64], "qf": [64, 64]},
    "medium": {"pi": [128], "qf": [256, 256]},
    "big": {"pi": [256], "qf": [512, 512]},
}

# Of OpenLoop: the smallest population that is tried, how many generations a trial should have, and
# how many steps a whole episode is taken to have.
_SMALLEST, _FEWEST_GENERATIONS, _WHOLE_EPISODE = 8, 5, 1_000


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
    return {
        "gamma": 1 - params.pop("one_minus_gamma"),
        "batch_size": 2 ** params.pop("batch_size_pow"),
        "n_rollouts": 2 ** params.pop("n_rollouts_pow"),
        OF_POLICY + "net_arch": list(_NET_ARCHS[params.pop("net_arch")]),
        OF_POLICY + "activation_fn": params.pop("activation_fn"),
        **params,
    }


def _suggest_usual(trial: Any) -> None:
    trial.suggest_float("one_minus_gamma", 1e-3, 0.1, log=True)
    trial.suggest_float("learning_rate", 1e-5, 2e-3, log=True)
    trial.suggest_int("batch_size_pow", 5, 9)
    trial.suggest_int("learning_starts", *trials.learning_starts_range(), log=True)
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
        OF_POLICY + "net_arch": list(_NET_ARCHS[params.pop("net_arch")]),
        **updates,
        **params,
    }


def _of_policy(name: str, sampled_params: Params) -> Params:
    """One of them is an argument of the policy."""
    params = convert_model_free_params(sampled_params)
    params[OF_POLICY + name] = params.pop(name)
    return params


def sample_soft_params(trial: Any, n_actions: int, n_envs: int, additional_args: Params) -> Params:
    """Sampler of the SAC family: also how fast target networks follow."""
    trial.suggest_float("tau", 1e-3, 0.08, log=True)
    return sample_model_free_params(trial, n_actions, n_envs, additional_args)


def sample_block_params(trial: Any, n_actions: int, n_envs: int, additional_args: Params) -> Params:
    """Sampler of SimBa and BRO: as the SAC family, with residual blocks."""
    sample_soft_params(trial, n_actions, n_envs, additional_args)
    return convert_block_params(trial.params)


def convert_block_params(sampled_params: Params) -> Params:
    """
    :param sampled_params: ``trial.params`` of a trial of :func:`sample_block_params`
    :return: hyperparameters
    """
    blocks = _BLOCKS[sampled_params["net_arch"]]
    params = convert_model_free_params(sampled_params)
    params[OF_POLICY + "net_arch"] = {part: list(widths) for part, widths in blocks.items()}
    return params


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
    horizon = trial.suggest_categorical("horizon", [100, 200, 400, 0]) or _WHOLE_EPISODE
    most = _candidates(horizon)
    n_resets = trial.suggest_int("n_resets", 1, min(4, max(1, most // _SMALLEST)))
    largest = max(_SMALLEST, min(32, most // n_resets)).bit_length() - 1
    trial.suggest_int("population_pow", 3, largest)
    trial.suggest_float("initial_sigma", 0.3, 2.0, log=True)
    trial.suggest_float("kp", 0.5, 20.0, log=True)
    trial.suggest_float("kd_share", 0.01, 0.2, log=True)
    trial.suggest_categorical("gain_factor", [1.0, 4.5])
    trial.suggest_float("amplitude", 0.3, 2.0, log=True)
    trial.suggest_float("offset", 0.1, 1.0)
    trial.suggest_float("lowest_frequency", 0.1, 1.0, log=True)
    trial.suggest_float("frequency_ratio", 3.0, 20.0, log=True)
    return convert_open_loop_params(trial.params)


def _candidates(horizon: int) -> int:
    """:return: episodes of this length in each of a few generations"""
    now = trials.budget()
    return 32 * 4 if now is None else now.n_timesteps // (_FEWEST_GENERATIONS * horizon)


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


_BLOCKWISE = ("simba", "bro")

SAMPLERS: dict[str, Callable[[Any, int, int, Params], Params]] = {
    "pods": sample_planner_params,
    "hds": sample_planner_params,
    "gsde_sac": sample_gsde_params,
    "crossq_jax": sample_model_free_params,
    "tqc_jax": sample_tqc_params,
    "td7": sample_td7_params,
    "openloop": sample_open_loop_params,
    "droq": sample_soft_params,
    **dict.fromkeys(_BLOCKWISE, sample_block_params),
}
CONVERTERS: dict[str, Callable[[Params], Params]] = {
    "pods": convert_planner_params,
    "hds": convert_planner_params,
    "gsde_sac": convert_gsde_params,
    "crossq_jax": convert_model_free_params,
    "tqc_jax": convert_tqc_params,
    "td7": convert_model_free_params,
    "openloop": convert_open_loop_params,
    "droq": convert_model_free_params,
    **dict.fromkeys(_BLOCKWISE, convert_block_params),
}
