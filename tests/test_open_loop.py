"""OpenLoop: published gaits walk, a search finds some, and joints are those that are driven."""

import json

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from gymnasium import spaces
from gymnasium.wrappers import TransformObservation
from odd_envs import ACT, AnySpaces
from small_models import same, saved, small
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecNormalize

from sb3_hds import OpenLoop
from sb3_hds.algos.open_loop import cma_es
from sb3_hds.algos.open_loop.gait import Constants
from sb3_hds.core.transforms.oscillators import Gait, target_at
from sb3_hds.envs import TwinVecEnv
from sb3_hds.errors import EnvironmentMismatchError
from sb3_hds.wrappers import ShowJoints

TAU = 2.0 * np.pi

# Gaits that the authors of the open-loop paper published: kp, kd in commands per rad and rad/s.
SWIMMER = {"amplitude": 1.0, "phase": [0.0, TAU * 0.95], "kp": 10.0, "kd": 0.5}
SWIMMER |= dict.fromkeys(("omega_swing", "omega_stance"), TAU * 0.62)


class Tune(AnySpaces):
    """Rewards a command that is a given sine of time. Episodes have 40 steps of 50 ms."""

    dt = 0.05

    def __init__(self, noise: float = 0.0) -> None:
        super().__init__(ACT)
        self.noise = noise

    def reset(self, *, seed=None, options=None):
        started = super().reset(seed=seed)
        self.luck = self.noise * float(self.np_random.normal())
        return started

    def step(self, action):
        obs, *_ = super().step(action)
        wanted = 0.5 * np.sin(TAU * (self.n - 0.5) * self.dt) + 0.2
        return obs, self.luck - float((action[0] - wanted) ** 2), False, self.n == 40, {}


def test_a_published_gait_swims_as_far_as_published():
    given = OpenLoop("MlpPolicy", "Swimmer-v5", seed=0).set_constants(**SWIMMER)
    model = OpenLoop("MlpPolicy", "Swimmer-v5", seed=1)
    model.set_constants(**json.loads(json.dumps(given.constants)))

    returns = [evaluate_policy(model, make_vec_env("Swimmer-v5", seed=s), 1)[0] for s in range(2)]

    assert model.constants == given.constants and 345.0 < np.mean(returns) < 358.0


def swimmer(env="Swimmer-v5", **settings):
    return OpenLoop("MlpPolicy", env, **settings)


def hidden():
    env, nothing = gymnasium.make("Swimmer-v5", max_episode_steps=50), spaces.Box(0.0, 0.0, (1,))
    return TransformObservation(env, lambda _: np.zeros(1, np.float32), nothing)


@each(DummyVecEnv, pytest.param(SubprocVecEnv, marks=pytest.mark.expensive))
def test_joints_that_are_not_observed_are_read_from_the_environment(kind):
    shown = make_vec_env("Swimmer-v5", env_kwargs={"max_episode_steps": 50}, seed=5)
    expected = OpenLoop("MlpPolicy", shown, seed=5).set_constants(**SWIMMER)
    env = make_vec_env(hidden, n_envs=2, vec_env_cls=kind, seed=5)
    try:
        model = OpenLoop("MlpPolicy", env, seed=5).set_constants(**SWIMMER)
        shown.seed(5)
        env.seed(5)
        wanted, _ = evaluate_policy(expected, shown, 1, return_episode_rewards=True)
        found, _ = evaluate_policy(model, env, 2, return_episode_rewards=True)
    finally:
        env.close()
    assert found[0] == pytest.approx(wanted[0], abs=1e-9)


def test_a_model_that_has_no_joints_to_read_says_where_it_could_get_them():
    model = OpenLoop("MlpPolicy", hidden())
    alone = OpenLoop.load(saved(model))
    with pytest.raises(EnvironmentMismatchError, match=r"read_joints_from.*ShowJoints"):
        alone.predict(np.zeros(1, np.float32))
    with pytest.raises(EnvironmentMismatchError, match="do not show position and velocity"):
        OpenLoop("MlpPolicy", hidden(), joints="observation")
    shown = OpenLoop("MlpPolicy", ShowJoints(hidden()), joints="observation")
    assert shown.policy.robot.seen_position == (1, 2) and shown.policy.robot.seen_velocity == (3, 4)


def test_the_state_that_predict_returns_carries_the_phase():
    model = OpenLoop("MlpPolicy", "Pendulum-v1", seed=0)
    model.set_constants(amplitude=1.5, phase=0.7, omega_swing=3.0, omega_stance=5.0)
    gait = Gait(*map(jnp.asarray, ([1.5], [0.0], [0.7], 3.0, 5.0)))
    obs, state, start = np.zeros((2, 3), np.float32), None, np.ones(2, bool)
    model.predict(obs)
    with pytest.warns(UserWarning, match="without the state that it returned"):
        model.predict(obs)

    for k in range(60):
        actions, state = model.predict(obs, state, start)
        # The second copy starts another episode at step 40.
        times = np.array([k, k if k < 40 else k - 40]) + 0.5
        expected = [target_at(gait, 0.05 * time)[0] for time in times]
        np.testing.assert_allclose(actions[:, 0], expected, atol=1e-4)
        start = np.array([False, k == 39])


def test_a_search_finds_the_gait_that_is_rewarded():
    model = OpenLoop("MlpPolicy", Tune(), seed=0, frequency=(0.5, 2.0), n_resets=1)

    model.learn(40 * 400)

    # Doing nothing costs 40 (0.5^2 / 2 + 0.2^2) = 6.6.
    assert evaluate_policy(model, model.get_env(), 1)[0] > -0.5
    found = model.constants
    assert found["omega_swing"] == pytest.approx(TAU, rel=0.1)
    assert abs(found["amplitude"][0]) == pytest.approx(0.5, abs=0.1)


def test_a_search_is_the_same_however_many_copies_there_are():
    def searched(n_envs):
        env = make_vec_env(Tune, n_envs=n_envs, env_kwargs={"noise": 1.0})
        model = OpenLoop("MlpPolicy", env, seed=4, population_size=6, horizon=10, ranking_share=0.0)
        model.learn(10 * 6 * 2 * 3)
        return model.policy.search

    one, three = searched(1), searched(3)

    assert int(one.generation) == int(three.generation) == 3
    np.testing.assert_array_equal(one.mean, three.mean)


def test_all_candidates_of_a_generation_start_from_the_same_resets():
    seen = []

    class Watched(Tune):
        def reset(self, *, seed=None, options=None):
            seen.extend([seed] * (seed is not None))
            return super().reset(seed=seed, options=options)

    settings = {"population_size": 4, "n_resets": 2, "horizon": 5, "ranking_share": 0.0}
    model = OpenLoop("MlpPolicy", Watched(), seed=0, **settings)
    seen.clear()

    model.learn(5 * 4 * 2 * 2)

    # The first one is of the model itself.
    first, second = np.array(seen[1:17]).reshape(2, 4, 2)
    assert (first == first[0]).all() and (second == second[0]).all()
    assert len({*first[0], *second[0]}) == 4


def test_an_interrupted_search_goes_on_after_loading_as_if_nothing_had_happened():
    settings = {"population_size": 4, "n_resets": 2, "horizon": 5, "ranking_share": 0.0}
    whole = OpenLoop("MlpPolicy", Tune(noise=1.0), seed=2, **settings).learn(5 * 8 * 4)
    # In the second generation, in the middle of its fourth episode.
    part = OpenLoop("MlpPolicy", Tune(noise=1.0), seed=2, **settings)
    part.learn(5 * 8 * 4, callback=lambda *_: part.num_timesteps < 5 * 11 + 3)

    rest = OpenLoop.load(saved(part), env=Tune(noise=1.0))
    known = np.isfinite(rest.policy.search.returns).sum()
    rest.learn(5 * 8 * 4 - 5 * 11, reset_num_timesteps=False)

    # The steps of the episode that was cut off are made again.
    assert known == 3 and rest.num_timesteps == whole.num_timesteps + 3
    assert same(whole.get_parameters(), rest.get_parameters())


def test_a_restored_search_asks_for_what_cmaes_itself_would_ask_for():
    """A sphere, with the library keeping its own state."""
    from cmaes import CMA

    state = cma_es.init_search(np.array([2.0, -1.0, 0.5]), 0.7, 0, 6, 1, 2)
    own = CMA(mean=state.mean.copy(), sigma=0.7, population_size=6)

    for _ in range(20):
        points = cma_es.candidates(state)
        values = -(points**2).sum(axis=1)
        own.tell([(point, -value) for point, value in zip(points, values, strict=True)])
        state = cma_es.tell(state._replace(returns=values[:, None]))

        np.testing.assert_allclose(state.mean, own.mean, rtol=1e-9)
        np.testing.assert_allclose(state.sigma, own._sigma, rtol=1e-9)
    assert np.linalg.norm(state.mean) < 0.5


def test_the_ranking_prefers_what_is_good_on_fresh_resets_to_what_was_lucky():
    model = OpenLoop("MlpPolicy", Tune(noise=0.2), seed=0, n_resets=1, population_size=4)
    space, turn = model.gait_space, np.array(TAU)
    good = Constants(np.array([0.5]), np.array([0.2]), np.zeros(1), turn, turn, *np.zeros((2, 1)))
    lucky, honest = np.full(space.dim, 2.0), space.encode(good)
    found = model.policy.search._replace(
        mean=lucky,
        elites=np.stack([lucky, honest, lucky, lucky, lucky]),
        elite_returns=np.array([100.0, 1.0, -np.inf, -np.inf, -np.inf]),
    )
    model.policy.search, model.ranking_share = found, 1.0

    model.learn(40 * 12)

    np.testing.assert_allclose(model.constants["amplitude"], [0.5], atol=1e-6)


def test_legs_that_do_the_same_are_searched_as_one_each_ahead_by_its_lead():
    env_id = "sb3_hds/ElasticQuadruped-v0"
    model = OpenLoop("MlpPolicy", env_id, gait="trot", seed=0)
    space = model.gait_space
    point = np.random.default_rng(1).normal(size=space.dim)
    gait = space.decode(point)

    # Two joints in a leg: amplitudes, offsets, one phase between them, two frequencies.
    assert space.dim == 2 + 2 + 1 + 2
    np.testing.assert_allclose(gait.amplitude, np.tile(gait.amplitude[:2], 4))
    np.testing.assert_allclose(gait.offset, np.tile(gait.offset[:2], 4))
    cycle = np.pi / gait.omega_swing + np.pi / gait.omega_stance
    ahead = target_at(Gait(*(jnp.asarray(part) for part in gait[:5])), 0.5 * cycle)
    now = target_at(Gait(*(jnp.asarray(part) for part in gait[:5])), 0.0)
    np.testing.assert_allclose(now[2:4], ahead[:2], atol=1e-4)
    np.testing.assert_allclose(now[6:8], now[:2], atol=1e-4)


@each(
    *(("population_size", 1), ("n_resets", 0), ("frequency", [2.0, 1.0]), ("dt", 0.0)),
    *(("gain_factor", 0.5), ("control", "maybe"), ("kp", -1.0), ("gait", "gallop")),
    *(("gait", []), ("amplitude", 0.0)),
)
def test_an_argument_out_of_range_is_named_with_its_range(name, value):
    with pytest.raises(ValueError, match=rf"OpenLoop\({name}=.*: {name} must be"):
        small("openloop", **{name: value})


@each(
    (lambda: swimmer().set_constants(**SWIMMER | {"amplitude": [1.0] * 3}), "one for each of"),
    (lambda: swimmer().set_constants(**SWIMMER | {"omega_swing": 0.0}), "finite and above 0"),
    (lambda: swimmer(VecNormalize(make_vec_env("Swimmer-v5"))), "norm_obs=False"),
    (lambda: swimmer("HalfCheetah-v5", gait="trot"), "4 legs needs as many joints in each"),
)
def test_what_does_not_fit_the_body_is_refused(attempt, says):
    with pytest.raises((ValueError, EnvironmentMismatchError), match=says):
        attempt()


@each(
    (lambda: VecFrameStack(make_vec_env(Tune, n_envs=2), 2), 40),
    (lambda: TwinVecEnv("Pendulum", n_envs=2), 200),
    ids=["frames", "twin"],
)
def test_where_single_copies_cannot_be_reset_whole_episodes_are_run(make, steps):
    model = OpenLoop("MlpPolicy", make(), seed=0, population_size=2, n_resets=1, horizon=3)
    model.learn(2 * steps + 2)
    assert int(model.policy.search.generation) == 1 and model.num_timesteps == 2 * steps + 2


def test_a_reward_that_is_not_finite_is_an_error_and_no_result():
    class Broken(Tune):
        def step(self, action):
            obs, reward, *rest = super().step(action)
            return obs, float("nan") if self.n == 7 else reward, *rest

    model = OpenLoop("MlpPolicy", Broken(), seed=0)

    with pytest.raises(ValueError, match="not finite"):
        model.learn(100)
    assert not np.isfinite(model.policy.search.returns).any()
