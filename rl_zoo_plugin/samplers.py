"""
Search spaces of ``rl_zoo3 train -optimize``.

A sampler suggests plain numbers and names; its converter turns them into hyperparameters. The
sampler returns the converted ``trial.params``, so that ``--trial-id`` reproduces a trial exactly.
Entries of ``policy_kwargs`` in a file that are not searched stay; the zoo would replace all of
them.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

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

# Of OpenLoop: smallest population, minimum number of generations in a trial, and assumed steps of
# an episode without a horizon.
_SMALLEST, _FEWEST_GENERATIONS, _EPISODE = 8, 5, 1_000


class Sampler(NamedTuple):
    """
    Called by the zoo for a new trial.

    :param suggest: draws plain values, given an Optuna trial and the number of environments
    :param convert: turns ``trial.params`` into hyperparameters
    """

    suggest: Callable[[Any, int], None]
    convert: Callable[[Params], Params]

    def __call__(self, trial: Any, n_actions: int, n_envs: int, additional_args: Params) -> Params:
        """
        :param trial: an Optuna trial
        :param n_actions: unused, as ``additional_args``: the zoo passes both to every sampler
        :param n_envs: copies of the environment
        :return: hyperparameters
        """
        self.suggest(trial, n_envs)
        return self.convert(trial.params)


def _suggest_planner(trial: Any, _: int) -> None:
    trial.suggest_float("one_minus_gamma", 1e-3, 0.1, log=True)
    trial.suggest_float("learning_rate", 1e-4, 1e-2, log=True)
    trial.suggest_int("batch_size_pow", 6, 10)
    trial.suggest_int("n_rollouts_pow", 4, 8)
    trial.suggest_categorical("planner", ["ilqr", "first_order"])
    trial.suggest_categorical("net_arch", list(_NET_ARCHS))
    trial.suggest_categorical("activation_fn", ["tanh", "relu", "elu"])


def _convert_planner(sampled: Params) -> Params:
    params = dict(sampled)
    return {
        "gamma": 1 - params.pop("one_minus_gamma"),
        "batch_size": 2 ** params.pop("batch_size_pow"),
        "n_rollouts": 2 ** params.pop("n_rollouts_pow"),
        OF_POLICY + "net_arch": list(_NET_ARCHS[params.pop("net_arch")]),
        OF_POLICY + "activation_fn": params.pop("activation_fn"),
        **params,
    }


def _suggest_common(trial: Any) -> None:
    trial.suggest_float("one_minus_gamma", 1e-3, 0.1, log=True)
    trial.suggest_float("learning_rate", 1e-5, 2e-3, log=True)
    trial.suggest_int("batch_size_pow", 5, 9)
    trial.suggest_int("learning_starts", *trials.learning_starts_range(), log=True)
    trial.suggest_categorical("net_arch", list(_NET_ARCHS))


def _suggest_model_free(trial: Any, _: int) -> None:
    _suggest_common(trial)
    trial.suggest_int("gradient_steps_pow", 0, 4)
    trial.suggest_categorical("policy_delay", [1, 2, 3, 10, 20])


def _convert_model_free(sampled: Params) -> Params:
    params = dict(sampled)
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


def _with_policy_argument(name: str) -> Callable[[Params], Params]:
    """:return: a converter for model-free algorithms that have this argument in the policy"""

    def convert(sampled: Params) -> Params:
        params = _convert_model_free(sampled)
        params[OF_POLICY + name] = params.pop(name)
        return params

    return convert


def _suggest_sac(trial: Any, n_envs: int) -> None:
    trial.suggest_float("tau", 1e-3, 0.08, log=True)
    _suggest_model_free(trial, n_envs)


def _convert_blocks(sampled: Params) -> Params:
    params = _convert_model_free(sampled)
    blocks = _BLOCKS[sampled["net_arch"]]
    params[OF_POLICY + "net_arch"] = {part: list(widths) for part, widths in blocks.items()}
    return params


def _suggest_tqc(trial: Any, n_envs: int) -> None:
    n_quantiles = trial.suggest_int("n_quantiles", 5, 50)
    trial.suggest_int("top_quantiles_to_drop_per_net", 0, n_quantiles - 1)
    _suggest_sac(trial, n_envs)


def _suggest_td7(trial: Any, n_envs: int) -> None:
    """With one environment, TD7 makes one update per step, so there is no number to suggest."""
    trial.suggest_categorical("target_update_interval", [100, 250, 500])
    trial.suggest_float("exploration_noise", 0.05, 0.4, log=True)
    _suggest_common(trial)
    if n_envs > 1:
        trial.suggest_int("gradient_steps_pow", 0, 4)
    trial.suggest_categorical("policy_delay", [1, 2, 3])


def _suggest_gsde(trial: Any, _: int) -> None:
    trial.suggest_categorical("train_freq", [4, 8, 16, 64])
    trial.suggest_float("log_std_init", -4.0, 0.0)
    trial.suggest_float("tau", 1e-3, 0.08, log=True)
    _suggest_common(trial)
    trial.suggest_int("gradient_steps_pow", 0, 6)


def _suggest_open_loop(trial: Any, _: int) -> None:
    horizon = trial.suggest_categorical("horizon", [100, 200, 400, 0]) or _EPISODE
    episodes = _episodes_per_generation(horizon)
    n_resets = trial.suggest_int("n_resets", 1, min(4, max(1, episodes // _SMALLEST)))
    largest = max(_SMALLEST, min(32, episodes // n_resets)).bit_length() - 1
    trial.suggest_int("population_pow", 3, largest)
    trial.suggest_float("initial_sigma", 0.3, 2.0, log=True)
    trial.suggest_float("kp", 0.5, 20.0, log=True)
    trial.suggest_float("kd_share", 0.01, 0.2, log=True)
    trial.suggest_categorical("gain_factor", [1.0, 4.5])
    trial.suggest_float("amplitude", 0.3, 2.0, log=True)
    trial.suggest_float("offset", 0.1, 1.0)
    trial.suggest_float("lowest_frequency", 0.1, 1.0, log=True)
    trial.suggest_float("frequency_ratio", 3.0, 20.0, log=True)


def _episodes_per_generation(horizon: int) -> int:
    """:return: episodes of this length that the budget has for each generation"""
    now = trials.budget()
    return 32 * 4 if now is None else now.n_timesteps // (_FEWEST_GENERATIONS * horizon)


def _convert_open_loop(sampled: Params) -> Params:
    params = dict(sampled)
    lowest = params.pop("lowest_frequency")
    return {
        "horizon": params.pop("horizon") or None,
        "population_size": 2 ** params.pop("population_pow"),
        "kd": params["kp"] * params.pop("kd_share"),
        "frequency": [lowest, lowest * params.pop("frequency_ratio")],
        **params,
    }


#: samplers that an entry of ``sb3_hds.algos.registry`` may name
SAMPLERS = {
    "planner": Sampler(_suggest_planner, _convert_planner),
    "model_free": Sampler(_suggest_model_free, _convert_model_free),
    "sac": Sampler(_suggest_sac, _convert_model_free),
    "blocks": Sampler(_suggest_sac, _convert_blocks),
    "gsde": Sampler(_suggest_gsde, _with_policy_argument("log_std_init")),
    "tqc": Sampler(_suggest_tqc, _with_policy_argument("n_quantiles")),
    "td7": Sampler(_suggest_td7, _convert_model_free),
    "open_loop": Sampler(_suggest_open_loop, _convert_open_loop),
}
