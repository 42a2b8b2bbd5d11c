"""Exploration by state-dependent noise, beside SB3's and by what it does."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch as th
from small_models import STATES, logged, small
from stable_baselines3.common.distributions import StateDependentNoiseDistribution
from stable_baselines3.common.env_util import make_vec_env

from sb3_hds.algos import learn_compiled
from sb3_hds.algos.model_free.sac.networks import (
    Gaussian,
    exploration_std,
    log_probability,
    marginal_std,
)
from sb3_hds.algos.model_free.sac.update import forward


def both_noises(full_std: bool, use_expln: bool) -> tuple[Gaussian, np.ndarray, Any]:
    """:return: our Gaussian, actions before tanh, and SB3's distribution in double precision"""
    rng = np.random.default_rng(0)
    latent, means, before = rng.normal(size=(3, 7, 5))
    means, before = means[:, :2], 2.0 * before[:, :2]
    before[0, 0] = 5.0  # where the action is 1 but for 1e-4
    log_std = rng.normal(size=(5, 2 if full_std else 1)) - 1.0
    # SB3 expands a single column by ones of single precision; these are of double.
    wide = np.broadcast_to(log_std, (5, 2)).copy()
    theirs = StateDependentNoiseDistribution(2, True, use_expln=use_expln, squash_output=True)
    theirs.learn_features, theirs.latent_sde_dim = True, 5
    theirs.sample_weights(th.as_tensor(wide), 7)
    theirs.proba_distribution(*map(th.as_tensor, (means, wide, latent)))
    std = marginal_std(jnp.asarray(latent), exploration_std(jnp.asarray(wide), use_expln))
    return Gaussian(jnp.asarray(means), std, latent), before, theirs


@pytest.mark.parametrize("full_std, use_expln, double", [(False, True, True), (True, False, False)])
def test_state_dependent_noise_is_that_of_stable_baselines(full_std, use_expln, double):
    # SB3 has to find these from rounded actions again, which costs digits where they are near 1.
    rounding, of_actions = (1e-12, 1e-9) if double else (1e-5, 1e-5)
    with jax.enable_x64(double):
        gaussian, before, theirs = both_noises(full_std, use_expln)
        found = log_probability(gaussian, jnp.asarray(before))

        np.testing.assert_allclose(gaussian.std, theirs.distribution.stddev, rtol=rounding)
        np.testing.assert_allclose(jnp.tanh(gaussian.mean), theirs.mode(), rtol=rounding)
        expected = theirs.log_prob(th.tanh(th.as_tensor(before)))
        np.testing.assert_allclose(found, expected, rtol=of_actions, atol=of_actions)


def test_each_environment_has_its_noise_matrix_and_the_deviation_is_logged():
    env = make_vec_env("Pendulum-v1", 3, env_kwargs={"max_episode_steps": 10})
    model = small("gsde_sac", env, train_freq=5)
    lines = logged(model)

    model.learn(45, log_interval=1)

    policy, obs = model.policy, np.ones((3, 3), np.float32)
    gaussian, _ = forward(policy.actor_network, policy.agent_state.actor.weights, obs)
    noise = np.stack([gaussian.latent[0] @ matrix for matrix in policy.matrices])
    wanted = 2.0 * np.tanh(gaussian.mean + noise)
    np.testing.assert_allclose(model.predict(obs)[0], wanted, rtol=1e-4, atol=1e-6)
    assert len(np.unique(wanted)) == 3
    assert lines.column("train/std")[-1] == pytest.approx(np.exp(-3.0), rel=0.5)


@pytest.mark.parametrize("compiled", [False, True])
def test_a_noise_matrix_lasts_over_as_many_collections_as_it_takes(compiled):
    how = {"train_freq": 5, "sde_sample_freq": 20, "use_sde_at_warmup": True}
    how |= {"learning_starts": 50, "policy_kwargs": {"net_arch": [8], "log_std_init": -3.0}}
    model = small("gsde_sac", **how)
    model = learn_compiled(model, 40)[0][0] if compiled else model.learn(40)

    buffer, policy = model.replay_buffer, model.policy
    weights, seen = policy.agent_state.actor.weights, buffer.observations[:40, 0]
    gaussian, _ = forward(policy.actor_network, weights, seen)
    apart = np.arctanh(buffer.actions[:40, 0]) - gaussian.mean

    def misfit(steps: slice) -> float:
        """Of the one noise matrix that explains these steps best."""
        latent = np.asarray(gaussian.latent[steps])
        matrix, *_ = np.linalg.lstsq(latent, apart[steps], rcond=None)
        return float(np.abs(latent @ matrix - apart[steps]).max())

    assert misfit(slice(0, 20)) < 1e-5 and misfit(slice(20, 40)) < 1e-5
    assert misfit(slice(10, 30)) > 1e-3


def test_the_optimistic_actor_of_bro_explores_by_gsde_too():
    model = small("bro", use_sde=True, std_multiplier=0.5)
    policy, recipe = model.policy, model.policy.update_config
    actor, extra = policy.agent_state.actor.weights, policy.agent_state.extra
    moved = jax.tree.map(lambda weight: weight + 0.1, extra["actor"].weights)
    extra = extra | {"actor": extra["actor"]._replace(weights=moved)}
    policy.agent_state = policy.agent_state._replace(extra=extra)
    gaussian, _ = forward(recipe.actor, actor, STATES)
    shift = recipe.extra.network.apply(moved, STATES, gaussian.mean)
    policy.reset_noise()

    explored = policy.scale_action(model.predict(STATES)[0])

    apart = gaussian.latent @ policy.matrices[0]
    np.testing.assert_allclose(explored, jnp.tanh(gaussian.mean + shift + 0.5 * apart), atol=1e-5)
    assert np.abs(shift).min() > 1e-6 and np.abs(apart).min() > 1e-4
