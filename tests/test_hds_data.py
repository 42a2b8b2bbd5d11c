"""HDS and the data that it measures: what they correct, what they may not spoil, what is kept."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import gymnasium
import jax
import numpy as np
import pytest
from cases import each
from measuring import measured
from small_models import reloaded, same, small
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_hds import HDS, PODS, effects, twins
from sb3_hds.algos.twin.hds.algorithm import _effects_of, _native_of
from sb3_hds.algos.twin.hds.correction import Correction, CorrectionConfig, correct
from sb3_hds.algos.twin.hds.windows import ChangePoint
from sb3_hds.core import Trajectories
from sb3_hds.effects import force_of
from sb3_hds.errors import TrajectoryError
from sb3_hds.sysid import Finding
from sb3_hds.wrappers import ManualReset

REAL = "sb3_hds/PendulumReal-v1"


def wishes(twin, **changes):
    plain = {"names": tuple(twin.parameters), "residual_kwargs": {}, "seed": 0, "beta": 0.0}
    # Of the model itself: what is estimated alike is one program.
    plain |= {"suspected": ("coulomb_friction", "action_delay")}
    return CorrectionConfig(nominal=dict(twin.values), **(plain | changes))


def corrected(twin, data, n_new=10_000, **changes):
    return correct(twin, data, wishes(twin, **changes), 0.0, learn_force=True, n_new=n_new)


@pytest.fixture(scope="module")
def heavier():
    return measured(twins.make("PendulumReal", mass=1.3, damping=0.1), noise=0.01)


@pytest.fixture(scope="module")
def found(heavier):
    """What the data of the heavier pendulum correct."""
    return corrected(twins.make("PendulumReal"), heavier)


def inertia(twin) -> float:
    return (twin.values["mass"] / 3.0 + twin.values["payload"]) * twin.values["length"] ** 2


def real(env=REAL, **settings) -> HDS:
    """:return: a model in the twin of the real system, without pretraining and learned force"""
    own = {"twin": "PendulumReal", "beta": 0.0, "pretrain_epochs": 0}
    return small("hds", env, **(own | settings))


@pytest.fixture
def no_planning(monkeypatch):
    """Epochs of planning are counted, and take no time."""
    monkeypatch.setattr(HDS, "run_epoch", lambda self, gradient_steps: None)


def recorded(found):
    """:return: what is logged of a correction"""
    values, intervals = found.log()
    assert not values.keys() & intervals.keys()
    return values | intervals


def test_a_twin_that_is_exact_is_left_alone():
    twin = twins.make("PendulumReal")
    found = corrected(twin, measured(twin))

    assert found.twin is twin and not found.replan and found.fit is None and not found.attached
    assert found.error_twin < 1e-4
    line = {"model/error_twin": found.error_twin, "model/beta": 0.0, "model/forgotten": 0}
    assert recorded(found) == line
    residual: Any = SimpleNamespace(disagreement=0.3, accepted=True)
    hybrid = Correction(twin, 0.5, True, residual=residual, error_twin=0.2, error_hybrid=0.1)
    expected = {"error_twin": 0.2, "error_hybrid": 0.1, "beta": 0.5, "disagreement": 0.3}
    assert recorded(hybrid) == line | {f"model/{name}": n for name, n in expected.items()}


def test_parameters_are_corrected_and_suspects_that_explain_nothing_are_removed(found):
    line = recorded(found)

    assert found.replan and found.error_calibrated < 0.5 * found.error_twin
    assert inertia(found.twin) == pytest.approx(1.3 / 3.0, rel=0.02)
    assert found.twin.values["damping"] == pytest.approx(0.1, rel=0.1)
    assert found.fit["action_delay.torque.delay"] and not found.attached
    assert found.twin.structure() == twins.make("PendulumReal").structure()
    assert line["model/damping"] == found.twin.values["damping"]
    assert line["model/damping_low"] < 0.1 < line["model/damping_high"]
    assert not [key for key in line if "action_delay" in key]


def test_once_corrected_nothing_changes_any_more(found, heavier):
    own = wishes(twins.make("PendulumReal"))
    again = correct(found.twin, heavier, own, 0.0, learn_force=False, n_new=1000)
    assert not again.replan and again.error_calibrated <= found.error_calibrated * 1.001


def test_a_system_that_friction_holds_fast_is_not_taken_for_a_heavier_one():
    """A pendulum that dry friction holds near the top looks like a heavier one."""
    env = gymnasium.make(REAL, friction=0.3, noise=0.01, max_episode_steps=200)
    obs, actions = [env.reset(seed=0, options={"state": ([0.06], [0.9])})[0]], []
    for _ in range(200):
        _, angle, speed = obs[-1]
        actions.append(np.clip([-8.0 * angle - 2.0 * speed], -2.0, 2.0))
        obs.append(env.step(actions[-1])[0])
    assert np.abs(np.array(obs)[50:, 1]).max() < 0.2
    data = Trajectories.from_arrays([obs], [actions], dt=0.05)

    found = corrected(twins.make("PendulumReal"), data, suspected=())
    line = recorded(found)

    assert found.fit["mass"].estimate > 1.5 and line["model/mass"] == 1.0
    assert found.twin == twins.make("PendulumReal") and not found.replan
    assert not [key for key in line if key.endswith(("_low", "_high"))]


def test_suspected_effects_that_explain_something_are_attached():
    twin = twins.make("PendulumReal")
    hidden = effects.CoulombFriction(0, tau_c=0.3), effects.ActionDelay(0, delay=0.1)
    sizes = {"coulomb_friction.hinge.tau_c": 0.3, "action_delay.torque.delay": 0.1}

    found = corrected(twin, measured(twin.extend(*hidden), noise=0.01))

    assert found.attached == dict.fromkeys(sizes, 0.0)
    for name, size in sizes.items():
        assert found.fit[name].estimate == pytest.approx(size, rel=0.1)
        assert found.twin.values[name] == found.fit[name].estimate
    assert found.error_calibrated < 0.6 * found.error_twin


@pytest.mark.expensive
def test_what_has_no_parameter_is_left_to_the_learned_force():
    twin = twins.make("PendulumReal")
    data = measured(twin.extend(effects.CoulombFriction(0, tau_c=0.4)), noise=0.005, n=10)

    small = {"n_members": 2, "net_arch": [16]}
    found = corrected(twin, data, beta="auto", suspected=(), residual_kwargs=small)

    assert found.beta > 0.0 and force_of(found.twin) is not None
    assert found.error_hybrid < 0.9 * found.error_calibrated < 0.9 * found.error_twin


def test_an_attached_force_that_no_longer_helps_is_switched_off(heavier):
    """Its weights are random here: what it learned is no longer true."""
    plain = twins.make("PendulumReal", mass=1.3, damping=0.1)
    twin = plain.extend(effects.NeuralForce(n_members=2, net_arch=(4,), share=1.0))
    tiny = {"n_members": 2, "net_arch": [4]}
    own = wishes(plain, names=(), suspected=(), beta="auto", residual_kwargs=tiny)

    found = correct(twin, heavier, own, 1.0, learn_force=False, n_new=1000)

    ((key, _),) = [force_of(found.twin)]
    assert found.beta == 0.0 and found.twin.values[f"{key}.share"] == 0.0
    assert found.error_hybrid > 1.5 * found.error_calibrated and found.replan


def test_data_from_before_a_change_are_forgotten():
    before = measured(twins.make("PendulumReal"), n=4)
    after = measured(twins.make("PendulumReal", payload=0.5), n=4, seed=1)
    both = Trajectories.concatenate([before, after])

    found = corrected(twins.make("PendulumReal"), both, n_new=after.n_steps)
    mixed = corrected(twins.make("PendulumReal"), both, n_new=both.n_steps)

    assert found.change_point is not None and mixed.change_point is None
    assert found.error_calibrated < 1e-3 < mixed.error_calibrated


def test_a_wrong_twin_is_seen_though_the_system_mostly_rests():
    moving = measured(twins.make("PendulumReal", mass=0.75), n=1)
    resting = Trajectories.from_arrays(
        obs=[np.tile([1.0, 0.0, 0.0], (201, 1))], actions=[np.zeros((200, 1))], dt=0.05
    )

    found = corrected(twins.make("PendulumReal"), Trajectories.concatenate([resting, moving]))

    assert found.replan and found.error_calibrated < 0.1 * found.error_twin


@pytest.mark.expensive
def test_on_a_planted_mismatch_hds_does_better_than_pods():
    """Both pretrain in the same wrong twin; HDS sees 200 steps of the real system."""
    returns = {}
    for algorithm in (PODS, HDS):
        env = gymnasium.make(REAL, mass=1.25, length=1.3)
        wrong = twins.make("PendulumReal", substeps=2)
        sizes = {"pretrain_epochs": 60, "n_rollouts": 64, "train_freq": 100}
        model = algorithm(env, twin=wrong, seed=0, **sizes).learn(200)
        model.env.seed(1000)
        returns[algorithm], _ = evaluate_policy(model, model.env, 20)

    # Seen, depending on rounding: PODS -260 and -624, HDS -243 and -237.
    assert returns[HDS] > returns[PODS] + 10.0


def test_what_is_diagnosed_is_the_twin_as_it_was_before_any_data(heavier, monkeypatch):
    model = real(pretrain_data=heavier)
    model.twin = model.twin.with_parameters(mass=1.3)
    monkeypatch.setattr("sb3_hds.algos.twin.hds.algorithm.diagnose", lambda *given, **_: given)

    twin, data = model.diagnose()

    assert twin.values["mass"] == 1.0 and data.n_steps == heavier.n_steps
    with pytest.raises(TrajectoryError, match="learn"):
        small("hds", REAL).diagnose()


def finding(effect: str) -> Finding:
    place = {"slot": "joint", "index": 0, "name": "hinge"}
    return Finding(effect, place, {}, (), 0.0, 0.0, 1.0, "")


def test_what_a_diagnosis_finds_is_attached_unless_the_twin_has_a_parameter_for_it(heavier):
    """A negative size of an effect cannot be attached: less of a parameter is less of it."""
    believed = twins.make("PendulumReal", damping=0.05)
    model = small("hds", REAL, twin=believed, pretrain_data=heavier, calibrated=None)
    findings = [finding("viscous_friction"), finding("coulomb_friction")]
    found = SimpleNamespace(findings=findings, twin=believed.with_parameters(damping=0.01))
    model.diagnose = lambda **_: found

    assert model.extend_model() is found

    tau = "coulomb_friction.hinge.tau_c"
    assert [one.key for one in model.twin.attached] == ["coulomb_friction.hinge"]
    assert (model.twin.values["damping"], model.twin.values[tau]) == (0.01, 0.0)
    assert (model.nominal["damping"], model.nominal[tau]) == (0.01, 0.0)
    # Again, there is nothing new to attach.
    before = model.twin
    found.findings = findings[1:]
    model.extend_model()
    assert model.twin is before and small("hds", REAL).extend_model() is None


@pytest.mark.expensive  # a whole diagnosis
def test_what_the_data_name_is_attached_and_estimated_from_then_on():
    rubbing = twins.make("PendulumReal").extend(effects.CoulombFriction(0, tau_c=0.3))
    model = real(pretrain_data=measured(rubbing, n=10, n_steps=100, noise=0.01))

    found = model.extend_model(effects=[effects.CoulombFriction, effects.ActionDelay])

    assert [f.effect for f in found.findings] == ["coulomb_friction"]
    assert model.twin.values["coulomb_friction.hinge.tau_c"] == pytest.approx(0.3, rel=0.1)
    assert reloaded(model.learn(0), env=REAL).twin == model.twin


def test_findings_become_effects_or_parameters_that_the_twin_has():
    pushed = twins.make("FreePendulum", driven=True, dt=0.02)
    flips = _effects_of(finding("sign_flip"), pushed)
    turned = {f"sign_flip.hinge_{what}" for what in ("position", "velocity")}
    assert {a.key for a in pushed.extend(*flips).attached} == turned

    twin = twins.make("PendulumReal", damping=0.02)
    assert _native_of(finding("viscous_friction"), twin) == {"damping": 0.02}
    assert _native_of(finding("quadratic_drag"), twin) == {}


def test_a_share_of_the_rollouts_is_in_the_learned_model():
    twin = twins.make("PendulumReal").extend(effects.NeuralForce(n_members=1, net_arch=(2,)))
    model = small("hds", REAL, twin=twin, n_rollouts=8)
    for share in (0.0, 0.25, 1.0):
        model.model_beta = share
        (chosen,) = model.varied(model.twin).values()
        assert sorted(set(np.asarray(chosen).tolist())) in ([0.0], [0.0, 1.0], [1.0])
        assert chosen.mean() == share


def test_each_rollout_is_planned_in_a_twin_of_its_own():
    model = small("pods", randomisation=1.0, pretrain_epochs=0)
    drawn = model.varied(model.twin)
    assert set(drawn) == set(model.twin.parameters) and np.std(drawn["mass"]) > 0.05
    assert small("pods").varied(model.twin) == {}

    def trained(factor):
        model = small("pods", randomisation=1.0)
        model.varied = lambda twin: {name: factor * leaf for name, leaf in drawn.items()}
        return model.learn(0).get_parameters()

    assert not same(trained(1.0), trained(1.5))


def test_effects_are_attached_by_name_or_as_they_are():
    model = small("hds", REAL, effects=["coulomb_friction", effects.QuadraticDrag(0, c=0.01)])
    assert model.twin.values["coulomb_friction.hinge.tau_c"] == 0.0
    assert model.twin.values["quadratic_drag.hinge.c"] == 0.01


@each(
    ({"effects": ["magic"]}, "viscous_friction"),
    ({"suspected": ["magic"]}, "magic"),
    ({"calibrated": ["weight"]}, "Its parameters are: gravity"),
    ({"pretrain_data": "missing.npz"}, "no file"),
    ({"pretrain_data": 3}, "Trajectories or the path"),
    ({"beta": "always"}, "a number from 0 to 1"),
    ({"residual_kwargs": {"members": 3}}, "n_members, net_arch, caution"),
    ({"refit_freq": -1}, "at least 0"),
)
def test_settings_of_learning_from_data_are_checked_at_the_door(settings, says):
    with pytest.raises(ValueError, match=says):
        small("hds", REAL, **settings)


def columns(model):
    buffer = model.replay_buffer
    n = buffer.size()
    return {
        name: getattr(buffer, name)[:n]
        for name in ("observations", "next_observations", "actions", "rewards", "timeouts")
    }


def test_a_file_corrects_the_model_and_travels_with_it(tmp_path, heavier, monkeypatch, no_planning):
    def rubs(twin, data, *_, **__):
        np.testing.assert_array_equal(data.obs, heavier.obs)
        return Correction(twin.with_parameters(damping=0.1), 0.0, replan=True)

    monkeypatch.setattr("sb3_hds.algos.twin.hds.algorithm.correct", rubs)
    path = heavier.save(tmp_path / "log")
    model = real(pretrain_data=str(path), refit_freq=0, train_freq=50).learn(50)
    assert model.twin.values["damping"] == 0.1

    loaded = reloaded(model, env=REAL)

    for name, values in columns(model).items():
        np.testing.assert_array_equal(columns(loaded)[name], values, err_msg=name)
    assert loaded.twin.values == model.twin.values and loaded.nominal == model.nominal
    assert loaded.measured.trajectories().n_steps == heavier.n_steps + 50


def test_a_learned_force_travels_as_tensors():
    twin = twins.make("PendulumReal")
    force = effects.NeuralForce(share=1.0).fitted_to(twin)
    twin = twin.extend(force.with_tensors(**force.fresh(jax.random.key(7))))
    model = small("pods", REAL)

    loaded = reloaded(small("pods", REAL, twin=twin), env=REAL)

    kept, expected = jax.tree.leaves(loaded.twin.tensors), jax.tree.leaves(twin.tensors)
    assert expected and all(map(np.array_equal, kept, expected))
    with pytest.raises(ValueError, match=r"does not fit this model.*learned_force"):
        reloaded(model, twin=twin, env=None)


def test_what_counts_since_a_change_is_remembered_in_real_steps(monkeypatch, no_planning):
    counted = []

    def changed_once(twin, data, *_, change, **__):
        counted.append((data.n_steps, change))
        found = Correction(twin, 0.0, replan=True, attached={"friction": 0.0})
        return dataclasses.replace(
            found, change_point=ChangePoint(15, 0) if len(counted) == 2 else None
        )

    monkeypatch.setattr("sb3_hds.algos.twin.hds.algorithm.correct", changed_once)
    monkeypatch.setattr("sb3_hds.algos.twin.hds.algorithm._REPLAN_EPOCHS", 2)
    model = real(train_freq=10, gradient_steps=3).learn(10).learn(20)

    assert (model.num_timesteps, model.real_timesteps) == (20, 30)
    # Fifteen of the first twenty steps, and the ten that came after.
    assert counted == [(10, None), (20, None), (30, ChangePoint(25, 0))]
    # What was believed of effects that were attached is known from then on.
    assert model.nominal["friction"] == 0.0
    # Planning anew is no block of its own.
    assert model._n_updates == 3 * (2 + 1) * 3


def test_after_a_change_the_force_is_learned_again_once_the_data_since_have_doubled(
    monkeypatch, no_planning
):
    learns = []
    force: Any = SimpleNamespace(disagreement=0.0)

    def changed(twin, *_, learn_force, n_new, **__):
        learns.append(learn_force)
        return Correction(
            twin,
            0.0,
            replan=False,
            change_point=ChangePoint(n_new, 0) if len(learns) == 2 else None,
            residual=force if learn_force else None,
        )

    monkeypatch.setattr("sb3_hds.algos.twin.hds.algorithm.correct", changed)
    model = real(refit_freq=0, train_freq=10).learn(20)
    for _ in range(4):
        model.correct_model()
        model.learn(20)

    # With 20 steps; with 40, of which 20 count from then on; with 40 of these; not yet with 60.
    assert learns == [True, True, True, False]


def test_what_acts_after_a_comparison_acts_until_the_next_one(monkeypatch):
    learns, acting = [], []

    def changed(twin, *_, **__):
        learns.append(True)
        return Correction(twin, 0.0, replan=len(learns) == 2)

    def noted(self, gradient_steps):
        usual(self, gradient_steps)
        acting.append((self._replanning, self.policy.networks.acting))

    usual = HDS.run_epoch
    monkeypatch.setattr(HDS, "run_epoch", noted)
    monkeypatch.setattr("sb3_hds.algos.twin.hds.algorithm.correct", changed)
    monkeypatch.setattr("sb3_hds.algos.twin.hds.algorithm._REPLAN_EPOCHS", 2)
    real(train_freq=25).learn(50)

    assert [remaining for remaining, _ in acting] == [0, 2, 1, 0]
    (_, compared), *again, _ = acting
    for _, weights in again:
        assert all(map(np.array_equal, *map(jax.tree.leaves, (weights, compared))))


def test_a_step_that_no_callback_saw_stored_ends_with_its_episode(no_planning):
    model = real(refit_freq=0)
    stop = lambda *_: model.num_timesteps < 7  # noqa: E731

    model.learn(25, callback=stop)
    assert model.measured.trajectories().lengths.tolist() == [7]
    model.learn(0)

    assert model.measured.trajectories().lengths.tolist() == [6]
    model.learn(25, callback=stop)
    model.set_env(model.get_env())
    assert model.measured.trajectories().lengths.tolist() == [6, 6]


def test_a_step_that_was_counted_and_never_stored_changes_no_number_of_a_recording(no_planning):
    model = real(refit_freq=0)

    counted = lambda: len(model.measured.recordings())  # noqa: E731

    model.learn(25, callback=lambda *_: bool(counted()) and model.num_timesteps < 7)
    model.learn(0)
    assert counted() == 1
    model.learn(25)

    assert model.measured.recordings().origin.tolist() == [0, 1]


def test_a_step_that_is_not_stored_yet_leaves_the_oldest_one_in_a_full_buffer(no_planning):
    model = real(refit_freq=0, buffer_size=10).learn(13)
    before = columns(model)["observations"].copy()

    model.learn(20, callback=lambda *_: False, reset_num_timesteps=False)

    assert model.measured.trajectories().n_steps == 10
    np.testing.assert_array_equal(columns(model)["observations"], before)


@each(
    ({"max_saved_steps": 200}, 60, 120),
    ({"max_saved_steps": 90}, 60, 30),
    ({"max_saved_steps": 40}, 40, 0),
    ({"max_saved_steps": 0}, 0, 0),
)
def test_early_data_share_the_limit_and_the_latest_stay(settings, n_real, n_early, no_planning):
    """Recordings of 60 steps: as many whole ones as there is room for, or the end of the last."""
    data = measured(twins.make("PendulumReal"), n=3)
    model = real(pretrain_data=data, train_freq=20, refit_freq=0, **settings).learn(60)

    loaded = reloaded(model, env=REAL)

    assert loaded.replay_buffer.size() == n_real
    latest = columns(model)["observations"][60 - n_real :]
    np.testing.assert_array_equal(columns(loaded)["observations"], latest)
    if n_real:
        found = loaded.measured.recordings()
        assert found.n_steps == n_real + n_early
        assert found.origin.tolist() == [0, 1, 2, 3][-len(found) :]
    if n_early:
        kept = data.obs[2][-1 - min(n_early, 60) :]
        np.testing.assert_array_equal(found.episode(len(found) - 2)[0], kept)


def test_an_episode_that_was_ended_by_hand_is_truncated(no_planning):
    env = ManualReset(gymnasium.make(REAL, mass=1.2))
    model = real(env, refit_freq=0)

    def press(_locals, _globals):
        if model.num_timesteps == 10:
            env.request()
        return True

    model.learn(25, callback=press)

    assert np.flatnonzero(model.replay_buffer.timeouts[:25, 0]).tolist() == [10]
    assert model.measured.trajectories().lengths.tolist() == [11, 14]


def test_diagnoses_come_as_often_as_asked_for(no_planning):
    model, asked = real(diagnose_freq=2, train_freq=10, refit_freq=0), []
    model.extend_model = lambda: asked.append(model.num_timesteps)
    model.learn(60)
    assert asked == [20, 40, 60]


def test_the_first_episode_plays_what_was_asked_for_and_no_other_does(no_planning, tmp_path):
    commands = np.linspace(-1.5, 1.5, 12)[:, None]
    asked = Trajectories.from_arrays([np.zeros((13, 3))], [commands], dt=0.05)
    env = gymnasium.make(REAL, max_episode_steps=20)
    file = str(asked.save(tmp_path / "next.npz"))

    model = real(env, first_commands=file, refit_freq=0, train_freq=10).learn(40)
    first, second = (model.measured.trajectories().episode(i)[1] for i in (0, 1))
    again = reloaded(model, env=env).learn(20, reset_num_timesteps=True)

    assert first[:12] == pytest.approx(commands, abs=1e-6)
    assert not np.allclose(first[12:], 1.5) and not np.allclose(second[:12], commands, atol=0.1)
    assert not np.allclose(again.measured.trajectories().episode(2)[1][:12], commands, atol=0.1)


def test_first_commands_are_of_the_environment(no_planning):
    asked = Trajectories.from_arrays([np.zeros((13, 3))], [np.zeros((12, 2))], dt=0.05)
    with pytest.raises(TrajectoryError, match=r"shape \(2,\), and the environment takes \(1,\)"):
        real(first_commands=asked)
    with pytest.raises(TrajectoryError, match="first_commands takes"):
        real(first_commands=3)
