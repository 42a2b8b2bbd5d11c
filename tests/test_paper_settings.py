"""
What each model-free algorithm is made with, unless told otherwise: the numbers of its paper, and
SB3's and SB3-Contrib's for the networks of GSDESAC and TQC (TQC's paper has five critics of three
layers of 512, which are in its file for MuJoCo's tasks). But critics of CrossQ (2048) and SimBa
(512, with a learning rate of 1e-4) have a quarter of the paper's width, for two cores, and BRO's
replay ratio is that of its fast variant (10). The paper's are in their files for MuJoCo's tasks.
"""

from typing import Any

import pytest
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

from sb3_hds import algos

EVERY_EPISODE = TrainFreq(1, TrainFrequencyUnit.EPISODE)
EVERY_EIGHT_STEPS = TrainFreq(8, TrainFrequencyUnit.STEP)

#: by id, attributes of a model with one control
OF_THE_MODEL: dict[str, dict[str, Any]] = {
    # Raffin et al. 2021: noise of 8 steps.
    "gsde_sac": {"use_sde": True, "train_freq": EVERY_EIGHT_STEPS, "gradient_steps": 8},
    # Hiraoka et al. 2022.
    "droq": {"gradient_steps": 20, "policy_delay": 20, "batch_size": 256, "tau": 0.005},
    # Bhatt et al. 2024.
    "crossq_jax": {"gradient_steps": 1, "policy_delay": 3, "batch_size": 256},
    # Kuznetsov et al. 2020.
    "tqc_jax": {"top_quantiles_to_drop_per_net": 2, "batch_size": 256, "tau": 0.005},
    # Lee et al. 2025.
    "simba": {"gradient_steps": 2, "batch_size": 256, "ent_coef": "auto_0.01", "tau": 0.005},
    # Nauman et al. 2024.
    "bro": {"gradient_steps": 2, "batch_size": 128, "kl_target": 0.05, "std_multiplier": 0.75}
    | {"param_resets": [15_000]},
    # Fujimoto et al. 2023.
    "td7": {"learning_starts": 25_000, "train_freq": EVERY_EPISODE, "batch_size": 256}
    | {"policy_delay": 2, "target_update_interval": 250, "target_policy_noise": 0.2}
    | {"target_noise_clip": 0.5, "exploration_noise": 0.1, "priority_exponent": 0.4}
    | {"max_episodes_per_checkpoint": 20, "updates_before_checkpointing": 750_000}
    | {"reset_weight": 0.9},
}
#: by id: learning rate and, for one control, target entropy
RATES = {
    "gsde_sac": (3e-4, -1.0),
    "droq": (3e-4, -1.0),
    "crossq_jax": (1e-3, -1.0),
    "tqc_jax": (3e-4, -1.0),
    "simba": (4e-4, -0.5),
    "bro": (3e-4, -0.5),
}
#: by id: widths of actor and critics, values of each critic, and optimiser
NETWORKS = {
    "gsde_sac": ((256, 256), (256, 256), 1, "adam", {}),
    "droq": ((256, 256), (256, 256), 1, "adam", {}),
    "crossq_jax": ((256, 256), (512, 512), 1, "adam", {"b1": 0.5}),
    "tqc_jax": ((256, 256), (256, 256), 25, "adam", {}),
    "simba": ((128,), (128, 128), 1, "adamw", {"weight_decay": 1e-2}),
    "bro": ((256,), (512, 512), 100, "adamw", {"weight_decay": 1e-4}),
}
#: by id: attributes of the critics' body
BODIES = {
    "droq": {"dropout_rate": 0.01, "layer_norm": True},
    "crossq_jax": {"renorm_warmup_steps": 100_000, "momentum": 0.99, "layer_norm": False},
}


def having(thing: Any, expected: dict[str, Any]) -> dict[str, Any]:
    return {attribute: getattr(thing, attribute) for attribute in expected}


@pytest.mark.parametrize("name", OF_THE_MODEL)
def test_arguments_and_networks_are_those_of_the_paper(name):
    model: Any = algos.ALL[name](env="Pendulum-v1", buffer_size=1000)
    policy = model.policy

    assert having(model, OF_THE_MODEL[name]) == OF_THE_MODEL[name]
    if name == "td7":
        kept = policy.arguments
        assert kept["net_arch"] == (256, 256) and kept["embedding_size"] == 256
        assert (kept["activation_fn"], kept["qf_activation_fn"]) == ("relu", "elu")
        assert model.learning_rates() == pytest.approx((3e-4, 3e-4))
        return
    hyper = model.hyperparams()
    assert (hyper.learning_rate, hyper.target_entropy) == pytest.approx(RATES[name])
    assert hyper.qf_learning_rate == hyper.learning_rate
    actor, critics, n_values, optimizer, arguments = NETWORKS[name]
    assert policy.widths == (actor, critics) and policy.n_critics == 2
    assert policy.critic_network.n_values == n_values
    assert name != "bro" or model.multiplier_rate * hyper.learning_rate == pytest.approx(3e-5)
    for used in policy.optimizers:
        assert (used.make.__name__, dict(used.arguments)) == (optimizer, arguments)
    assert having(policy.critic_network.body, BODIES.get(name, {})) == BODIES.get(name, {})


def test_bro_with_the_ratio_of_the_paper_starts_afresh_as_often_as_there():
    model = algos.BRO(env="Pendulum-v1", buffer_size=1000, gradient_steps=10)
    in_thousands = [15, 50, 250, 500, 750, 1_000, 1_500, 2_000]
    assert model.param_resets == [1_000 * n for n in in_thousands]
