"""What the benchmark of the model-free family runs, and what it makes of the runs."""

from importlib.util import find_spec
from inspect import signature

import gymnasium
import intervals
import model_free
import model_free_report
import numpy as np
import pandas as pd
import pytest
from model_free import CAR, LENGTHS, ONLY_ON, OURS, PEERS, PENDULUM
from runs import InterruptedRun

from rl_zoo_plugin.lazy import parameters_of

zoo = pytest.mark.skipif(find_spec("rl_zoo3") is None, reason="needs the extra 'zoo'")

#: what RL Zoo 2.9.2 has for -v4
OF_THE_ZOO = {
    (PENDULUM, "sbx_crossq"): {"policy_delay": 2, "policy_kwargs": {"net_arch": [256, 256]}},
    ("Hopper-v5", "contrib_tqc"): {"learning_starts": 10_000, "top_quantiles_to_drop_per_net": 5},
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
def test_every_setting_of_a_method_is_an_argument_of_its_class():
    for method in (*OURS, *PEERS):
        for env in ONLY_ON.get(method, LENGTHS):
            algorithm, settings = model_free.made_of(env, method)
            known = parameters_of(algorithm) if method in OURS else signature(algorithm).parameters
            assert set(settings) <= set(known), (env, method)
            assert len(model_free.marks(env, method)) > 1


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


def test_episodes_side_by_side_are_those_of_one_after_the_other(monkeypatch):
    monkeypatch.setattr(model_free, "N_EPISODES", 3)

    class Policy:
        def predict(self, obs, deterministic):
            assert deterministic
            return np.tanh(obs[:, 5:8]), None

    expected = []
    for episode in range(3):
        system = gymnasium.make("Hopper-v5")
        (obs, _), total, over = system.reset(seed=70_000 + episode), 0.0, False
        while not over:
            action, _ = Policy().predict(obs[None], True)
            obs, reward, terminated, truncated, _ = system.step(action[0])
            total, over = total + reward, terminated or truncated
        expected.append(total)

    assert model_free.evaluation("Hopper-v5")(Policy()).tolist() == expected


@pytest.mark.expensive
def test_noise_that_stays_finds_a_goal_to_which_no_reward_leads():
    model = model_free.learner(CAR, "gsde_sac", seed=0)

    model.learn(6_000)

    assert model_free.evaluation(CAR)(model).mean() > model_free_report.TARGETS[CAR]


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


def test_steps_that_one_method_saves_are_counted_in_the_median_over_seeds():
    sac = {seed: [(1000 * i, -1000.0 + 110.0 * i) for i in range(1, 9)] for seed in range(3)}
    fast, slow = [(1000, -900.0), (2000, -110.0)], [(1000, -900.0), (2000, -800.0)]
    runs = table(sac=sac, droq={0: fast, 1: slow, 2: fast})

    end, swing_up, target = model_free_report.fewer_steps(runs).to_dict("records")

    assert (end["goal"], end["steps"], end["times"]) == (-120.0, 2000.0, 4.0)
    assert (swing_up["goal"], swing_up["steps_of_other"]) == (-200.0, 8000.0)
    assert (target["goal"], target["steps"], target["times"]) == (-150.0, 2000.0, 4.0)


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
