"""Algorithms that plan in a twin; where PODS stands for both, HDS shares every line."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from point_mass import PointMass, point_mass_env
from small_models import logged, same, small
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_hds import twins
from sb3_hds.algos.twin.policy import all_finite
from sb3_hds.algos.twin.regression import learn_policy, learn_value
from sb3_hds.algos.twin.state import planning_problem
from sb3_hds.core import Twin
from sb3_hds.errors import RewardError


class Lossy(PointMass):
    """Breaks down where it starts to the right of 0.5 m."""

    name = "Lossy"

    def actuate(self, state, action, params):
        return jnp.where(state.q > 0.5, jnp.nan, super().actuate(state, action, params))


class Broken(PointMass):
    """Breaks down at once."""

    name = "Broken"

    def actuate(self, state, action, params):
        return super().actuate(state, action, params) + jnp.nan


class Aimless(PointMass):
    name = "Aimless"
    reward = Twin.reward


class Flat(PointMass):
    name = "Flat"
    reward_has_gradient = False


def finite(model) -> bool:
    return all_finite(model.policy.networks)


def hyper_of(model, gradient_steps):
    return model.hyperparams(model.twin, gradient_steps)._replace(learning_rate=1e-3)


def close(first, second) -> bool:
    near = jax.tree.map(lambda a, b: bool(jnp.allclose(a, b, rtol=1e-5)), first, second)
    return all(jax.tree.leaves(near))


def test_pretraining_is_done_once_without_a_step_of_the_environment():
    env = gymnasium.make("Pendulum-v1")
    model = small("hds", env, pretrain_epochs=2, train_freq=10, gradient_steps=-1)
    lines = logged(model)

    model.learn(0)

    assert model.num_timesteps == 0 and env.unwrapped.last_u is None
    progress = model.policy.progress
    assert (model.n_pretrained, int(progress.n_epochs), model._n_updates) == (2, 2, 0)
    assert lines.column("pretrain/time/epochs") == [1, 2]
    assert model.twin_timesteps == lines.column("pretrain/time/twin_timesteps")[-1] > 0
    model.learn(30)
    model.learn(30)
    # One epoch after every tenth real step of both calls, of as many steps.
    assert int(model.policy.progress.n_epochs) == 2 + 3 + 3
    assert model.num_timesteps == 30 and model._n_updates == 60


def test_the_rate_follows_its_schedule_over_the_epochs(monkeypatch):
    model = small("pods", pretrain_epochs=4, learning_rate="lin_1e-2")
    rates, hyperparams = [], model.hyperparams

    def recorded(*arguments):
        hyper = hyperparams(*arguments)
        rates.append(float(hyper.learning_rate))
        return hyper

    monkeypatch.setattr(model, "hyperparams", recorded)
    model.learn(0)

    # A straight line from 0.01 to 0 over four epochs.
    np.testing.assert_allclose(rates, [1e-2, 0.75e-2, 0.5e-2, 0.25e-2])


def test_where_no_sample_is_finite_no_scale_moves():
    model = small("pods", point_mass_env(), twin=Broken(), pretrain_epochs=0).learn(0)
    inside = model._epoch_state().networks.inside
    logged(model)

    model.run_epoch(gradient_steps=4)

    # Eight rollouts of four steps.
    assert model.logger.name_to_value["train/dropped_samples"] == 8 * 4 and finite(model)
    np.testing.assert_array_equal(model.policy.networks.inside.mean, inside.mean)
    np.testing.assert_array_equal(model.policy.networks.inside.scale, inside.scale)


def test_samples_that_are_not_finite_are_dropped_and_counted():
    model = small("pods", point_mass_env(), twin=Lossy(), pretrain_epochs=10)
    lines = logged(model)

    model.learn(30)

    dropped = lines.column("pretrain/dropped_samples")
    # A quarter of the starts lies right of 0.5 m; there are 8 rollouts of 4 steps.
    assert 0 < sum(dropped) < 10 * 8 * 4 and max(dropped) < 8 * 4 and finite(model)


# A single step of infinite length is noticed by the weights alone: its loss was finite.
@pytest.mark.parametrize(("rate", "gradient_steps"), [(1e38, 4), (1e39, 1)])
def test_a_regression_that_diverges_is_an_error_and_keeps_the_last_good_state(rate, gradient_steps):
    model = small("pods", gradient_steps=gradient_steps).learn(0)
    before = model.get_parameters()
    model.learning_rate = rate
    model._setup_lr_schedule()

    with pytest.raises(FloatingPointError, match="Lower learning_rate"):
        model.learn(50)

    assert finite(model)
    kept = model.get_parameters()
    assert same({part: kept[part] for part in ("policy", "policy.optimizer")}, before)


def test_arguments_of_the_environment_reach_the_twin_unless_one_was_passed():
    model = small("pods", make_vec_env("Pendulum-v1", 2, env_kwargs={"g": 9.8})).learn(25)
    passed = small("pods", twin=twins.make("Pendulum", mass=1.2))
    workspace = model._workspace

    assert model.twin.values["gravity"] == 9.8
    model.set_env(make_vec_env("Pendulum-v1", 2, env_kwargs={"g": 9.8}))
    assert model._workspace is workspace
    model.set_env(make_vec_env("Pendulum-v1", 2, env_kwargs={"g": 3.7}))
    # Plans of the former environment are forgotten.
    assert model.twin.values["gravity"] == 3.7 and model._workspace is None
    model.learn(25)
    passed.set_env(gymnasium.make("Pendulum-v1", g=9.8))
    assert passed.twin.values == {"gravity": 10.0, "mass": 1.2, "length": 1.0}


def test_some_rollouts_go_on_for_long_while_others_start_afresh():
    model, seen = small("pods", reset_share=0.5, pretrain_epochs=60), {}

    def look(*_):
        # Callbacks are called while programs compile, too.
        if model._workspace is not None:
            seen[model._epochs_done] = np.asarray(model._workspace.ages)
        return True

    model.learn(0, callback=look)

    # They go on by two steps per epoch; the first quarter starts afresh once in eight epochs, the
    # last one seven times.
    ages = np.mean([seen[epoch] for epoch in range(21, 61)], axis=0)
    assert ages[:2].mean() > 6.0 > 2.0 > ages[6:].mean()


def test_random_plans_are_tried_for_half_of_the_rollouts():
    # Of so many, some surely win against the policy's own plan.
    none, some = (small("pods", n_random_plans=n, pretrain_epochs=1).learn(0) for n in (0, 32))

    program = some._epoch_config
    # Four of eight: each draws so many plans, and improves and follows the best of them.
    columns = 2 * 1 + 1
    improving = program.n_iterations * program.horizon * (1 + columns + program.n_step_sizes)
    more = 4 * (32 * program.horizon + improving + program.lookahead)
    assert some.twin_timesteps - none.twin_timesteps == more
    assert not same(none.get_parameters(), some.get_parameters())


def test_the_policy_learns_from_the_first_half_of_plans_and_the_value_from_all():
    model = small("pods", pretrain_epochs=1, learned_share=0.5).learn(0)
    state, program = model._epoch_state(), model._epoch_config
    hyper = hyper_of(model, 4)
    # Four steps of eight rollouts, first steps first.
    late = jnp.arange(4 * 8) >= 2 * 8

    def learned_with(field, where):
        samples = state.workspace.samples
        rows = getattr(samples, field)
        mask = where.reshape(1, -1, *[1] * (rows.ndim - 2))
        changed = samples._replace(**{field: jnp.where(mask, rows + 1.0, rows)})
        workspace = state.workspace._replace(samples=changed)
        given = (program, state._replace(workspace=workspace), hyper)
        return state.networks._replace(actor=learn_policy(*given)[0], value=learn_value(*given)[0])

    before = learned_with("control", jnp.zeros_like(late))
    assert close(learned_with("control", late).actor, before.actor)
    assert not close(learned_with("control", ~late).actor, before.actor)
    assert not close(learned_with("value", late).value, before.value)


def test_the_better_of_two_policies_acts():
    model = small("pods", point_mass_env(), compare_every=1, pretrain_epochs=9, adapt_scales=False)
    nets = model.learn(0).policy.networks
    good, bad = nets.average, jax.tree.map(lambda leaf: leaf + 5.0, nets.average)

    def compared(average, acting):
        # Without regression steps, the average of equal policies stays what it is.
        model.policy.networks = nets._replace(actor=average, average=average, acting=acting)
        model.run_epoch(0)
        values = model.logger.name_to_value
        return values["train/return_of_average"], values["train/return_of_best"]

    of_average, of_best = compared(average=good, acting=bad)
    assert of_average == of_best and close(model.policy.networks.acting, good)
    of_average, of_best = compared(average=bad, acting=good)
    assert of_average < of_best and close(model.policy.networks.acting, good)
    # Scales stay those of the first rollouts where they shall.
    assert all(map(np.array_equal, model.policy.networks.inside, nets.inside))


def test_a_policy_whose_model_changes_is_compared_before_it_acts():
    changing, fixed = (
        small(name, train_freq=20, **own).learn(40).logger.name_to_value
        for name, own in (("hds", {}), ("pods", {"compare_every": 100}))
    )

    assert "train/return_of_best" in changing and "train/return_of_best" not in fixed


def test_pretraining_ends_where_plans_gain_nothing_and_schedules_go_on_from_its_end():
    # More than a plan can gain.
    model = small("pods", least_gain=1e9, pretrain_epochs=30).learn(0)
    assert (model.n_pretrained, model._progress_remaining()) == (20, 0.0)
    assert model.learn(0).n_pretrained == 20


PAPER = dict.fromkeys(("gain_weight", "sensitivity_weight", "averaging", "least_gain"), 0.0)
PAPER |= {"reset_share": 1.0, "learned_share": 1.0, "gamma": 1.0, "loss": "squared"}
PAPER |= {"n_random_plans": 0, "lookahead": 0, "compare_every": 0, "plan_memory": 1}
PAPER |= {"terminal_value": False, "adapt_scales": False, "policy_kwargs": {"linear_path": False}}


HOT = {"temperature": 1e3, "n_random_plans": 0}


@each(
    ("pods", {}),
    # Without random plans there is no second one to fall back on.
    ("hds", HOT),
    ("pods", PAPER | {"planner": "gauss_newton"}),
    ids=["as usual", "hot", "paper"],
)
def test_plans_are_never_worse_than_what_they_started_from_unless_hot(name, changes):
    lines = logged(model := small(name, pretrain_epochs=10, **changes))

    model.learn(0)

    before, after = (lines.column(f"pretrain/plan_return_{at}") for at in ("before", "after"))
    worsened, hot = sum(lines.column("pretrain/worsened_plans")), changes is HOT
    assert finite(model) and (worsened > 0) == hot
    assert hot or ((np.subtract(after, before) >= 0.0).all() and after != before)
    if "planner" in changes:
        assert set(lines.column("pretrain/value_loss")) == {0.0}
    if hot:
        expected = [1e3 * 0.9**n for n in range(10)]
        assert lines.column("pretrain/temperature") == pytest.approx(expected)


def test_what_an_end_is_worth_has_a_switch():
    worth = {}
    for shifted in (True, False):
        model = small("pods", "InvertedPendulum-v5", shift_ends=shifted)
        problem = planning_problem(model._epoch_config, model._epoch_state(), hyper_of(model, 4))
        worth[shifted] = float(problem.value_when_terminated)
        best = float(problem.reward_offset * problem.reward_scale)
    # A reward of zero for ever, counted from the best one; or nothing.
    assert worth == {True: pytest.approx(-best / (1.0 - model.gamma)), False: 0.0} and best > 0.0


def test_statistics_of_a_normalised_environment_are_of_whole_episodes_and_stay_if_frozen():
    env, frozen = (VecNormalize(DummyVecEnv([point_mass_env]), training=on) for on in (True, False))

    for one in (env, frozen):
        small("pods", one)._epoch_state()

    # Random episodes of PointMass, 20 steps with forces uniform in [-1, 3] N, spread by 1.8 m and
    # 0.7 m/s around 1.9 m and 1.1 m/s; plans drawn at random are smoother, so they spread more.
    spread, mean = np.sqrt(env.obs_rms.var), env.obs_rms.mean
    assert (spread > [1.0, 0.4]).all() and (spread < [5.0, 2.5]).all()
    assert (np.abs(mean) < [4.0, 2.5]).all()
    assert (frozen.obs_rms.mean == 0.0).all() and (frozen.obs_rms.var == 1.0).all()


@pytest.mark.parametrize("twin, reason", [(Aimless, "no reward"), (Flat, "planning_reward")])
def test_a_twin_whose_reward_leads_nowhere_is_refused(twin, reason):
    with pytest.raises(RewardError, match=reason):
        small("pods", point_mass_env(), twin=twin())
