"""``sb3_hds.load_policy``: a policy from a file of which nothing is unpickled."""

import re
import traceback

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch as th
from cases import each
from gymnasium import spaces
from small_models import STATES, greedy, repacked, saved, small
from stable_baselines3 import SAC

import sb3_hds
from sb3_hds import algos
from sb3_hds.algos.base.policy_file import space_from_plain, space_to_plain


@pytest.mark.parametrize("name", ["simba", "td7", "hds", "openloop"])
def test_a_policy_alone_acts_as_its_model_and_nothing_is_unpickled(name, no_pickle):
    model = small(name, seed=3)
    if name == "simba":
        model.policy.update_obs_stats(STATES)

    policy = sb3_hds.load_policy(saved(model))

    np.testing.assert_array_equal(greedy(policy), greedy(model))
    explored, _ = policy.predict(STATES)
    assert explored.shape == (2, 1) and np.abs(explored).max() <= 2.0
    assert policy.observation_space == model.observation_space
    assert policy.action_space == model.action_space


def test_checkpoints_of_td7_act_in_the_policy_alone(no_pickle, tmp_path):
    model = small("td7", use_checkpoints=True, train_freq=None)
    model.policy.keep_checkpoint()
    learner = model.policy.agent_state
    actor = jax.tree.map(lambda weight: weight + 0.1, learner.checkpoint.actor)
    other = learner.checkpoint._replace(actor=actor)
    model.policy.agent_state = learner._replace(checkpoint=other)

    model.policy.save(tmp_path / "policy.pth")
    alone = type(model.policy).load(tmp_path / "policy.pth")
    for policy in (sb3_hds.load_policy(saved(model)), alone):
        np.testing.assert_array_equal(greedy(policy), greedy(model))
    model.policy.drop_checkpoint()
    assert (greedy(model) != greedy(policy)).any()


@each(
    spaces.Box(np.array([-np.inf, -1.0]), np.array([np.inf, 2.5]), dtype=np.float64),
    spaces.Box(0, 255, (2, 3), np.uint8),
    spaces.Discrete(4, start=-1),
    spaces.MultiDiscrete([2, 3], start=[0, 1]),
    spaces.MultiBinary([2, 2]),
    spaces.Dict([("z", spaces.Discrete(2)), ("a", spaces.Box(-1.0, 1.0, (1,)))]),
)
def test_spaces_come_back_from_plain_data(space):
    assert space_from_plain(space_to_plain(space)) == space


@each(
    ("bro", {"n_quantiles": np.int64(5), "net_arch": np.array([8, 8])}, ("net_arch", [8, 8])),
    ("droq", {"net_arch": [8], "activation_fn": th.nn.GELU}, ("activation_fn", "gelu_exact")),
)
def test_numbers_of_numpy_and_classes_of_torch_become_plain_data(name, kwargs, plain, no_pickle):
    model = small(name, policy_kwargs=kwargs)

    policy = sb3_hds.load_policy(saved(model))

    np.testing.assert_array_equal(greedy(policy), greedy(model))
    key, value = plain
    assert policy.arguments[key] == value


def test_a_function_of_ones_own_is_no_plain_data():
    kwargs = {"net_arch": [8], "activation_fn": lambda x: jnp.sin(x)}
    file = saved(small("gsde_sac", policy_kwargs=kwargs))
    with pytest.raises(ValueError, match=r"class or function of your own.*HDS\.load"):
        sb3_hds.load_policy(file)


def test_a_file_of_another_library_is_reported(tmp_path):
    SAC("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [8]}).save(tmp_path / "sac")
    with pytest.raises(ValueError, match="another library saved it"):
        sb3_hds.load_policy(tmp_path / "sac.zip")
    for algorithm in (algos.DroQ, algos.HDS, algos.OpenLoop):
        with pytest.raises(ValueError, match=r"SACPolicy.*loaded by the class of that algorithm"):
            algorithm.load(tmp_path / "sac")


def test_a_description_of_a_newer_version_is_reported():
    newer = lambda data: data.replace(b'"GaussianPolicy"', b'"TransformerPolicy"')  # noqa: E731
    with pytest.raises(ValueError, match=r"TransformerPolicy.*newer"):
        sb3_hds.load_policy(repacked(small("droq"), "data", newer))


def test_widths_that_do_not_fit_the_weights_are_damage_and_no_reason_to_unpickle():
    other = lambda data: re.sub(rb'"net_arch": \[[^]]*\]', b'"net_arch": [3]', data)  # noqa: E731
    with pytest.raises(ValueError, match="damaged, or") as caught:
        sb3_hds.load_policy(repacked(small("droq"), "data", other))
    assert "weights_only" not in "".join(traceback.format_exception(caught.value))
