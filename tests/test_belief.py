"""A belief over twins is a twin: every episode is under one draw, and nobody need know of it."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from small_models import greedy, reloaded, small

from sb3_hds import effects, envs, twins
from sb3_hds.core import rollout
from sb3_hds.core.belief import BeliefTwin
from sb3_hds.errors import ParameterError
from sb3_hds.sysid.belief.answers import Answer, Answers
from sb3_hds.sysid.belief.belief import belief_of, write_randomisation
from sb3_hds.sysid.reporting.figures import plot_belief

TWIN = twins.make("PendulumReal")
UNION = TWIN.extend(effects.ViscousFriction(0), effects.ActionDelay(0))
NAMES = list(UNION.parameters)
B, DELAY = (NAMES.index(n) for n in ("viscous_friction.hinge.b", "action_delay.torque.delay"))


def drawn(n=6):
    rows = np.tile(list(UNION.values.values()), (n, 1))
    rows[:, B] = np.linspace(0.0, 0.2, n)
    rows[n // 2 :, DELAY] = 0.05
    return rows


@pytest.fixture(scope="module")
def belief():
    return BeliefTwin(UNION, drawn(), np.arange(6) // 3, ("rubs", "rubs late"), (0.5, 0.5))


def number_of(state):
    return int(state.memory["belief"])


def test_an_episode_moves_as_the_member_that_it_drew(belief):
    actions = jnp.asarray(1.5 * np.sin(0.5 * np.arange(20))[:, None], jnp.float32)
    start = jax.jit(belief.initial)(jax.random.key(3), belief.params)
    moved = jax.jit(lambda s: rollout(belief, belief.params, s, actions))(start)
    number = number_of(start)
    member = belief.member(number)

    alone = start._replace(memory={k: m for k, m in start.memory.items() if k != "belief"})
    expected = jax.jit(lambda s, p: rollout(member, p, s, actions))(alone, member.params)

    assert np.allclose(moved.obs, expected.obs, atol=1e-5)
    assert np.allclose(moved.rewards, expected.rewards, atol=1e-4)
    assert set(np.asarray(moved.states.memory["belief"])) == {number}


def test_every_draw_begins_some_episode(belief):
    draw = jax.jit(jax.vmap(lambda key: belief.initial(key, belief.params)))
    numbers = np.asarray(draw(jax.random.split(jax.random.key(0), 300)).memory["belief"])

    share = np.bincount(numbers.astype(int), minlength=6) / 300
    # Five standard deviations of a share of a sixth.
    assert np.all(np.abs(share - 1 / 6) < 5 * np.sqrt(5 / 36 / 300))


def test_an_inferred_state_is_under_the_best_guess(belief):
    assert number_of(belief.infer(jnp.array([1.0, 0.0, 0.0]), belief.params)) == 0


def test_an_effect_on_a_belief_is_again_a_belief(belief):
    more = belief.extend(effects.TorqueGain(0, gain=0.9))

    assert isinstance(more, BeliefTwin) and more.n_draws == 6
    assert more.member(5).values["torque_gain.torque.gain"] == 0.9
    assert more.member(5).values["viscous_friction.hinge.b"] == pytest.approx(0.2)
    assert more.without("torque_gain.torque").member(5).values == belief.member(5).values


def test_a_belief_is_saved_as_plain_data_and_comes_back(belief, tmp_path):
    spec = json.loads(belief.save(tmp_path / "out.json").read_text())["twin"]

    again = twins.from_spec(spec, effects.ALL)

    assert again == belief and np.array_equal(again.draws, belief.draws)
    assert (again.answers, again.weights) == (belief.answers, belief.weights)
    assert "50.0%  rubs late" in str(again) and "action_delay.torque.delay" in str(again)
    spec["belief"]["parameters"][0] = "colour"
    with pytest.raises(ParameterError, match="another twin"):
        twins.from_spec(spec, effects.ALL)


def test_draws_have_to_be_of_the_twin_and_possible():
    with pytest.raises(ParameterError, match="rows of"):
        BeliefTwin(UNION, np.zeros((3, 2)))
    rows = drawn()
    rows[0, B] = -1.0
    with pytest.raises(ParameterError, match=r"viscous_friction\.hinge\.b"):
        BeliefTwin(UNION, rows)


def test_every_environment_has_its_draw_and_a_new_one_after_a_reset(belief):
    env = envs.TwinVecEnv(belief, 8, max_episode_steps=3)
    env.seed(0)
    env.reset()
    first = np.asarray(env.states.memory["belief"]).copy()
    for _ in range(2):
        env.step(np.zeros((8, 1)))
    assert np.array_equal(first, env.states.memory["belief"])
    env.step(np.zeros((8, 1)))

    assert len(set(first)) > 2 and not np.array_equal(first, env.states.memory["belief"])


@pytest.fixture(scope="module")
def two():
    rubs = Answer(
        ("viscous_friction.hinge",),
        TWIN.extend(effects.ViscousFriction(0, b=0.01)),
        {"viscous_friction.hinge.b": np.array([0.02])},
    )
    late = Answer(
        ("action_delay.torque",),
        TWIN.extend(effects.ActionDelay(0, delay=0.05)),
        {"action_delay.torque.delay": np.array([0.004])},
        np.log(1 / 3),
    )
    return Answers((rubs, late), np.ones(3), 1.0, 20, np.array([-1.0, 0.0, 0.0]))


def test_answers_have_their_shares_within_physical_bounds(two):
    belief = belief_of(two, n=400, seed=1)
    rubbing, late = belief.draws[belief.origin == 0], belief.draws[belief.origin == 1]
    names = list(belief.base.parameters)
    b, delay = (names.index(n) for n in ("viscous_friction.hinge.b", "action_delay.torque.delay"))

    assert (len(rubbing), len(late)) == (300, 100)
    assert belief.weights == pytest.approx((0.75, 0.25))
    assert belief.draws[0, b] == 0.01 and rubbing[:, b].min() >= 0.0
    assert not rubbing[:, delay].any() and not late[:, b].any()
    # A hundred draws: five standard errors of their mean, and of their standard deviation.
    assert late[:, delay].mean() == pytest.approx(0.05, abs=5 * 0.0004)
    assert late[:, delay].std() == pytest.approx(0.004, rel=5 / np.sqrt(200))


def test_a_randomisation_config_says_what_differs_and_keeps_rows_together(two, tmp_path):
    belief = belief_of(two, n=40)

    told = yaml.safe_load(write_randomisation(belief, tmp_path / "r.yml").read_text())

    assert [*told["parameters"]] == ["viscous_friction.hinge.b", "action_delay.torque.delay"]
    assert told["parameters"]["action_delay.torque.delay"]["unit"] == "s"
    varied = [list(belief.base.parameters).index(name) for name in told["parameters"]]
    assert np.array(told["draws"]) == pytest.approx(belief.draws[:, varied], rel=1e-5)
    assert told["fixed"]["mass"] == TWIN.values["mass"]


def test_what_all_draws_share_is_a_parameter_as_of_any_twin(belief):
    heavier = belief.with_parameters(mass=1.3)

    assert set(belief.varied) == {NAMES[B], NAMES[DELAY]} == set(NAMES) - set(belief.parameters)
    assert heavier == belief and heavier.member(4).values["mass"] == 1.3
    assert heavier.to_spec()["parameters"]["mass"] == 1.3
    with pytest.raises(ParameterError, match="no parameter"):
        belief.with_parameters(**{NAMES[B]: 0.1})


def test_a_picture_has_a_panel_for_each_parameter_that_differs(two, tmp_path):
    plot_belief(belief_of(two, n=40), tmp_path / "belief.png")

    assert (tmp_path / "belief.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.expensive  # compiles epochs of planning
@pytest.mark.parametrize("name", ["pods", "hds"])
def test_planners_learn_under_the_draws_and_save_them(belief, name):
    model = small(name, "sb3_hds/PendulumReal-v1", twin=belief)
    model.learn(60)

    again = reloaded(model, env="sb3_hds/PendulumReal-v1")

    assert isinstance(model.twin, BeliefTwin) and again.twin == model.twin
    assert np.array_equal(again.twin.draws, model.twin.draws)
    assert greedy(again).tolist() == greedy(model).tolist()
