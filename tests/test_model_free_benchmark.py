"""What the benchmark of the model-free family runs, and what it makes of the runs."""

import inspect
from importlib.util import find_spec

import gymnasium
import intervals
import model_free
import model_free_report
import numpy as np
import pandas as pd
import pytest
from model_free import CAR, LENGTHS, ONLY_ON, OURS, PEERS, PENDULUM
from runs import InterruptedRun
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise

from rl_zoo_plugin.lazy import parameters_of

zoo = pytest.mark.skipif(find_spec("rl_zoo3") is None, reason="needs the extra 'zoo'")

#: what RL Zoo 2.9.2 has for -v4
_WIDE = {"net_arch": {"pi": [256, 256], "qf": [2048, 2048]}}
OF_THE_ZOO = {
    (PENDULUM, "sb3_sac"): {"learning_rate": 1e-3},
    (PENDULUM, "sbx_tqc"): {"learning_rate": 1e-3},
    (PENDULUM, "sbx_crossq"): {"policy_delay": 2, "policy_kwargs": {"net_arch": [256, 256]}},
    ("Hopper-v5", "contrib_tqc"): {"learning_starts": 10_000, "top_quantiles_to_drop_per_net": 5},
    ("HalfCheetah-v5", "contrib_tqc"): {"learning_starts": 10_000},
    ("HalfCheetah-v5", "sbx_crossq"): {
        "buffer_size": 1_000_000,
        "learning_rate": 1e-3,
        "learning_starts": 5_000,
        "policy_delay": 3,
        "policy_kwargs": _WIDE,
    },
    ("HalfCheetah-v5", "sbx_droq"): {
        "learning_starts": 10_000,
        "policy_kwargs": {"dropout_rate": 0.01, "layer_norm": True},
        "gradient_steps": 20,
        "policy_delay": 20,
    },
}


def table(**runs: dict[int, list[tuple[int, float]]]) -> pd.DataFrame:
    """:param runs: of each method, by seed, steps and returns at the marks 1000, 2000, ..."""
    return pd.DataFrame(
        {
            "env": PENDULUM,
            "method": method,
            "seed": seed,
            "mark": 1000 * (i + 1),
            "steps": steps,
            "seconds": float(i + 1),
            "return": earned,
        }
        for method, by_seed in runs.items()
        for seed, points in by_seed.items()
        for i, (steps, earned) in enumerate(points)
    )


@zoo
@pytest.mark.parametrize(("env", "peer"), OF_THE_ZOO)
def test_peers_run_with_the_settings_of_the_zoo(env, peer):
    assert model_free.made_of(env, peer)[1] == OF_THE_ZOO[env, peer]


@zoo
@pytest.mark.parametrize("method", [*OURS, *PEERS])
def test_every_setting_of_a_method_is_an_argument_of_its_class(method):
    for env in ONLY_ON.get(method, LENGTHS):
        algorithm, settings = model_free.made_of(env, method)
        read = parameters_of if method in OURS else inspect.signature
        known = read(algorithm) if method in OURS else read(algorithm).parameters
        assert set(settings) <= set(known), env
        assert len(model_free.marks(env, method)) > 1


@pytest.mark.parametrize(
    ("name", "arch", "other"),
    [
        ("tqc_jax", {"pi": [256, 256], "qf": [256, 256]}, {}),
        ("crossq_jax", {"pi": [256, 256], "qf": [256, 256]}, {}),
        ("simba", {"pi": [128], "qf": [128, 128]}, {"learning_rate": 4e-4}),
    ],
)
def test_narrow_critics_are_all_that_differs_but_for_the_learning_rate_of_simba(name, arch, other):
    wide, narrow = (model_free.made_of("HalfCheetah-v5", n)[1] for n in (name, f"{name}_narrow"))

    own = wide.get("policy_kwargs", {})
    assert narrow == wide | {"policy_kwargs": own | {"net_arch": arch}} | other
    assert own.get("net_arch") != arch


@pytest.mark.parametrize(
    ("method", "file"), [("crossq_jax_512", "CrossQ"), ("simba_narrow", "SimbaSAC")]
)
def test_defaults_are_what_was_measured(method, file):
    algorithm, settings = model_free.made_of("HalfCheetah-v5", method)
    default = algorithm(env="Pendulum-v1", buffer_size=10)

    assert algorithm.__name__ == file
    arch = settings["policy_kwargs"]["net_arch"]
    assert default.policy.widths == (tuple(arch["pi"]), tuple(arch["qf"]))
    assert default.learning_rate == settings.get("learning_rate", default.learning_rate)


def test_what_a_narrow_layer_loses_of_its_steps_a_greater_learning_rate_makes_up_for():
    def begun(name):
        algorithm, settings = model_free.made_of("HalfCheetah-v5", name)
        return algorithm("MlpPolicy", "HalfCheetah-v5", **settings)

    wide, narrow = begun("simba"), begun("simba_narrow")

    assert narrow.learning_rate == 4.0 * wide.learning_rate
    assert [width // 4 for width in wide.policy.widths[1]] == list(narrow.policy.widths[1])


def test_a_long_run_goes_on_from_its_last_mark(tmp_path, monkeypatch):
    env, method = "InvertedPendulum-v5", "td7"
    monkeypatch.setattr(model_free, "LENGTHS", {env: (300, 100)})
    monkeypatch.setattr(model_free, "CACHE", tmp_path)
    made_of = model_free.made_of
    small = {"learning_starts": 50, "buffer_size": 1000, "batch_size": 16}
    monkeypatch.setattr(model_free, "made_of", lambda *run: (made_of(*run)[0], small))

    def interrupted_after(mark):
        def evaluate(model):
            if model.num_timesteps > mark:
                raise KeyboardInterrupt
            return np.array([float(model.num_timesteps)])

        return evaluate

    monkeypatch.setattr(model_free, "evaluation", lambda env: interrupted_after(290))
    with pytest.raises(KeyboardInterrupt):
        model_free.worker(env, method, 0)
    kept = InterruptedRun(tmp_path / "model_free" / f"{env}_{method}_0")
    before = kept.rows()
    model = kept.model(model_free.class_of(env, method), env)

    monkeypatch.setattr(model_free, "evaluation", lambda env: interrupted_after(1e9))
    rows = model_free.worker(env, method, 0)

    assert len(before) == 2
    assert model.num_timesteps == model.replay_buffer.size() == before[-1]["steps"] < 290
    assert model._n_updates > 0
    assert rows[:2] == before
    assert [row["mark"] for row in rows] == [100, 200, 300]
    assert 300 <= rows[-1]["steps"] <= 330
    assert not kept.folder.exists()


def test_episodes_side_by_side_are_those_of_one_after_the_other():
    class Policy:
        def predict(self, obs, deterministic):
            assert deterministic
            return np.tanh(obs[:, 5:8]), None

    expected = []
    for episode in range(model_free.N_EPISODES):
        system = gymnasium.make("Hopper-v5")
        (obs, _), total, over = system.reset(seed=70_000 + episode), 0.0, False
        while not over:
            action, _ = Policy().predict(obs[None], True)
            obs, reward, terminated, truncated, _ = system.step(action[0])
            total, over = total + reward, terminated or truncated
        expected.append(total)

    returns = model_free.evaluation("Hopper-v5")(Policy())

    assert returns.tolist() == expected
    assert len(set(expected)) > 1


def test_schedules_are_those_of_the_whole_run(monkeypatch):
    small = {"learning_starts": 4, "learning_rate": lambda remaining: 1e-3 * remaining}
    made_of = model_free.made_of
    monkeypatch.setattr(model_free, "made_of", lambda *run: (made_of(*run)[0], small))
    model = model_free.learner(PENDULUM, "td7", seed=0)

    for _ in range(2):
        model.learn(10, reset_num_timesteps=False)

    assert model.learning_rates()[0] == pytest.approx(1e-3 * (1.0 - model.num_timesteps / 10_000))


@pytest.mark.expensive
def test_noise_that_stays_finds_a_goal_to_which_no_reward_leads():
    model = model_free.learner(CAR, "gsde_sac", seed=0)

    model.learn(6_000)

    assert model_free.evaluation(CAR)(model).mean() > model_free_report.TARGETS[CAR]


def test_noise_of_a_file_is_that_of_the_zoo():
    noise = model_free.made_of(CAR, "bro")[1]["action_noise"]

    assert isinstance(noise, OrnsteinUhlenbeckActionNoise)
    assert noise._sigma == 0.5 and noise().shape == (1,)
    with pytest.raises(ValueError, match="pink"):
        model_free.noise_of("pink", 0.5)


def test_learners_that_stop_at_the_ends_of_episodes_are_compared_at_their_marks():
    runs = table(
        td7={
            0: [(1004, -900.0), (2013, -300.0)],
            1: [(1090, -700.0), (2001, -100.0)],
        }
    )

    [row] = model_free_report.summary(runs).to_dict("records")

    assert (row["mark"], row["seeds"], row["return"]) == (2000, 2, -200.0)
    assert model_free_report.first_mark(runs, -800.0) == 1000.0


def test_wall_times_are_steps_times_what_one_takes_on_the_same_day():
    runs = table(td7={0: [(300, -900.0), (1000, -300.0)]}, bro={0: [(1000, -700.0)]})
    pace = {"env": PENDULUM, "method": "td7", "first_steps": 400, "first_s": 20.0, "step_s": 0.05}

    seconds = model_free_report.wall_seconds(runs, pd.DataFrame([pace]))

    np.testing.assert_allclose(seconds, [15.0, 20.0 + 600 * 0.05, np.nan])


def test_a_method_below_the_interval_of_its_peer_is_named_at_the_last_mark_of_both():
    low, high = [(1000, -900.0), (2000, -310.0)], [(1000, -800.0), (2000, -290.0), (3000, -140.0)]
    runs = table(
        td7={0: low, 1: low},
        bro={0: high, 1: high},
        sbx_sac={0: high, 1: [(1000, -1000.0), (2000, -270.0)]},
    )

    shown = model_free_report.beside_peers(runs).set_index("method")

    assert shown.loc["td7", ["mark", "difference", "worse"]].tolist() == [2000, -30.0, "yes"]
    assert shown.loc["bro", ["mark", "difference", "worse"]].tolist() == [2000, -10.0, "no"]
    assert shown.loc["bro", "chance_of_more"] == 0.25


def test_a_single_run_of_a_peer_has_no_interval_to_lie_below():
    runs = table(td7={0: [(1000, -900.0)], 1: [(1000, -910.0)]}, sbx_sac={0: [(1000, -300.0)]})

    [row] = model_free_report.beside_peers(runs).to_dict("records")

    assert (row["difference"], row["worse"]) == (-605.0, "")


def test_runs_stand_beside_what_was_published():
    runs = table(
        sac={0: [(100_000, 5000.0)], 1: [(100_000, 4512.0)]},
        simba_narrow={0: [(100_000, 5522.0)]},
        td7={0: [(100_000, 9000.0)]},
    )
    runs["env"], runs["mark"] = "HalfCheetah-v5", 100_000

    sac, narrow = model_free_report.beside_papers(runs).to_dict("records")

    # Published: 6156 +- 700, and 5462 +- 598 with wide critics.
    assert sac["z"] == pytest.approx((4756.0 - 6156.0) / 700.0)
    assert narrow["z"] == pytest.approx(60.0 / 598.0)


def test_runs_stand_beside_what_was_published_half_way():
    runs = table(sac={0: [(50_000, 3714.0), (60_000, 4000.0)]})
    runs["env"], runs["mark"] = "HalfCheetah-v5", runs["steps"]

    [row] = model_free_report.beside_papers(runs).to_dict("records")

    assert (row["mark"], row["z"]) == (50_000, -1.0)


def test_steps_that_one_method_saves_are_counted_in_the_median_over_seeds():
    sac = {seed: [(1000 * i, -1000.0 + 110.0 * i) for i in range(1, 9)] for seed in range(3)}
    fast, slow = [(1000, -900.0), (2000, -110.0)], [(1000, -900.0), (2000, -800.0)]
    runs = table(sac=sac, droq={0: fast, 1: slow, 2: fast})

    end, swing_up, target = model_free_report.fewer_steps(runs).to_dict("records")

    assert (end["goal"], end["steps"], end["times"]) == (-120.0, 2000.0, 4.0)
    assert (swing_up["goal"], swing_up["steps_of_other"]) == (-200.0, 8000.0)
    assert (target["goal"], target["steps"], target["times"]) == (-150.0, 2000.0, 4.0)


def test_no_steps_are_saved_of_what_has_learned_nothing():
    runs = table(sac={0: [(1000, -0.1)]}, droq={0: [(1000, 94.0)]}).assign(env=CAR)

    assert model_free_report.fewer_steps(runs).empty


def test_steps_that_most_seeds_have_not_had_are_not_counted():
    runs = table(droq={0: [(1000, -140.0)], 1: [(1000, -900.0)], 2: [(1000, -900.0)]})

    assert model_free_report.median_first_mark(runs, -900.0) == 1000.0
    assert np.isnan(model_free_report.median_first_mark(runs, -150.0))


def test_intervals_are_those_of_rliable():
    library = pytest.importorskip("rliable.library")
    metrics = pytest.importorskip("rliable.metrics")
    rng = np.random.default_rng(0)
    ours, theirs = rng.normal(size=5), rng.normal(0.3, 2.0, size=8)
    of_mean = lambda scores: np.array([metrics.aggregate_mean(scores)])  # noqa: E731

    points, limits = library.get_interval_estimates({"ours": ours[:, None]}, of_mean, reps=10_000)

    mean, low, high = intervals.of_mean(ours)
    assert mean == pytest.approx(points["ours"][0])
    # Three standard errors of a 2.5 % quantile of 10,000 draws, in deviations of the mean.
    apart = 3.0 * 2.0 * ours.std() / np.sqrt(5) * np.sqrt(0.025 * 0.975 / 10_000) / 0.0584
    np.testing.assert_allclose([low, high], limits["ours"][:, 0], atol=apart)
    chance = metrics.probability_of_improvement(ours[:, None], theirs[:, None])
    assert intervals.chance_of_more(ours, theirs) == pytest.approx(chance)


def test_one_seed_has_no_interval():
    assert np.isnan(intervals.of_mean([3.0])[1:]).all()
    assert np.isnan(intervals.of_difference([3.0], [1.0, 2.0])[1:]).all()


def test_half_a_run_is_not_through():
    run = ("HalfCheetah-v5", "droq", 0)
    assert not model_free.through(run, [{"mark": 10_000}, {"mark": 50_000}])
    assert model_free.through(run, [{"mark": 50_000}, {"mark": 100_000}])
