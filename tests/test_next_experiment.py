"""What to record next: within every limit, under every answer, and worth what it says."""

import copy
import dataclasses
import html
import json
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pandas
import pytest
from cases import each
from measuring import measured
from scipy.optimize import least_squares

from sb3_hds import Trajectories, diagnose, effects, twins
from sb3_hds.core import rollout
from sb3_hds.errors import CalibrationError, ParameterError
from sb3_hds.sysid import Diagnosis
from sb3_hds.sysid.belief.answers import Answer, Answers, factor_of, union
from sb3_hds.sysid.belief.updated import updated
from sb3_hds.sysid.design import Limits
from sb3_hds.sysid.design.excitation import Excitation
from sb3_hds.sysid.design.experiment import design_problem, next_experiment
from sb3_hds.sysid.design.result import Pair

TWIN = twins.make("PendulumReal")
HANGING = np.array([-1.0, 0.0, 0.0])
LIMITS = {"velocity": 8.0, "torque": 1.8}


def answer(cause, twin, **deviations):
    """An answer whose parameters are independent, with these standard deviations."""
    rows = np.diag(list(deviations.values()))
    names = (name.replace("__", ".") for name in deviations)
    return Answer((cause,), twin, dict(zip(names, rows, strict=True)))


LATE = answer(
    "action_delay.torque",
    TWIN.extend(effects.ActionDelay(0, delay=0.06)),
    action_delay__torque__delay=0.01,
)
LAGGING = answer(
    "motor_lag.torque",
    TWIN.extend(effects.MotorLag(0, time_constant=0.06)),
    motor_lag__torque__time_constant=0.01,
)
HEAVY = answer("parameter.mass", TWIN.with_parameters(mass=1.15), mass=0.05)
WEAK = answer(
    "torque_gain.torque",
    TWIN.extend(effects.TorqueGain(0, gain=1.0 / 1.15)),
    torque_gain__torque__gain=0.05,
)


def left_open(*answers):
    return Answers(answers, np.array([0.01, 0.01, 0.05]), 2.0, 15, HANGING)


def designed(*answers, **changes):
    asked = {"seconds": 3.0, "progress": False} | changes
    return next_experiment(left_open(*answers), asked.pop("limits", LIMITS), **asked)


@each(
    ({"speed": 1.0}, "no limit 'speed'"),
    ({"velocity": -1.0}, "a positive number"),
    ({"velocity": {"elbow": 1.0}}, "names elbow"),
    ({"position": [1.0, -1.0]}, "a smallest and a larger"),
    ({"command": [5.0, 6.0]}, "leaves nothing"),
    ({"bandwidth": 100.0}, "half the sampling rate"),
    (3.0, "limits are a dictionary"),
)
def test_impossible_limits_are_refused_in_words(limits, words):
    with pytest.raises(ParameterError, match=words):
        Limits.of(limits).at(TWIN)


def test_limits_come_from_a_file_and_what_is_not_limited_is_what_the_twin_accepts(tmp_path):
    path = tmp_path / "limits.yml"
    path.write_text("velocity: {hinge: 6.0}\nposition: [-1, 2]\n")

    bounds = Limits.of(path).at(TWIN)

    assert bounds.velocity == [6.0] and bounds.torque == [np.inf]
    assert bounds.position.tolist() == [[-1.0, 2.0]]
    assert bounds.command.tolist() == [[TWIN.actuators[0].low, TWIN.actuators[0].high]]


def test_a_machine_without_motors_has_no_commands_to_choose():
    with pytest.raises(ParameterError, match="no actuator"):
        Limits().at(twins.make("FreePendulum"))


@each({"n": 0}, {"seconds": 0.01}, {"seed": -1}, {"start": [0.0]})
def test_impossible_questions_are_refused(changes):
    with pytest.raises(CalibrationError):
        designed(LATE, LAGGING, **changes)


def test_a_union_has_every_effect_and_what_an_answer_lacks_is_null():
    twin, values, factor = union((LATE, LAGGING))
    names = list(twin.parameters)
    delay, lag = (
        names.index(f"{one}")
        for one in ("action_delay.torque.delay", "motor_lag.torque.time_constant")
    )

    assert values[:, [delay, lag]].tolist() == [[0.06, 0.0], [0.0, 0.06]]
    assert np.flatnonzero(factor[0].any(1)).tolist() == [delay]
    assert np.flatnonzero(factor[1].any(1)).tolist() == [lag]


def test_a_factor_is_of_the_covariance_and_no_direction_is_wider_than_three_deviations():
    scale = np.array([2.0, 0.1])
    covariance = np.array([[1.0, 0.02], [0.02, 0.001]])

    factor = factor_of(covariance, scale)
    unknown = factor_of(np.array([[np.inf, np.inf], [np.inf, 0.0]]), scale)

    assert factor @ factor.T == pytest.approx(covariance)
    assert np.diag(unknown @ unknown.T) == pytest.approx(9.0 * scale**2)


def test_evidence_is_what_the_wrong_answer_leaves_when_all_that_is_free_is_fitted():
    """Against a solver that knows nothing of linearisation, on differences that are small."""
    rubbing = answer(
        "viscous_friction.hinge",
        TWIN.extend(effects.ViscousFriction(0, b=0.02)),
        viscous_friction__hinge__b=0.02,
    )
    dragging = answer(
        "quadratic_drag.hinge",
        TWIN.extend(effects.QuadraticDrag(0, c=0.005)),
        quadratic_drag__hinge__c=0.005,
    )
    n_steps, window = 30, 15
    actions = 1.5 * np.sin(0.4 * np.arange(n_steps))[None, :, None]
    asked = left_open(rubbing, dragging)
    twin, numbers, _ = design_problem(asked)
    with jax.enable_x64(True):
        found = (
            Excitation(twin, Limits().at(twin), n_steps, window).evaluate(actions, numbers).ratios
        )

        def simulated(twin, params, state, k, count):
            run = rollout(twin, params, state, jnp.asarray(actions[0, k : k + count]))
            return run.states, run.obs

        true, other = rubbing.twin, dragging.twin
        start = true.infer(jnp.asarray(HANGING), true.params)
        states, seen = jax.jit(lambda: simulated(true, true.params, start, 0, n_steps))()

        @jax.jit
        def errors(free):
            params = other.params | {"quadratic_drag.hinge.c": 0.005 + 0.005 * free[0]}
            parts = []
            for i, k in enumerate((0, window)):
                own = free[1 + 2 * i : 3 + 2 * i]
                begin = other.infer(jnp.asarray(HANGING), params)
                begin = begin._replace(q=states.q[k] + own[:1], v=states.v[k] + own[1:])
                obs = simulated(other, params, begin, k, window)[1]
                missed = (obs[:window] - seen[k : k + window]) / asked.noise
                parts.append(missed.ravel() / np.sqrt(asked.correlated))
            return jnp.concatenate([*parts, free[:1]])

        best = least_squares(lambda free: np.asarray(errors(jnp.asarray(free))), np.zeros(5))
    assert float(found[0, 1]) == pytest.approx(2.0 * best.cost, rel=0.03)
    assert float(found[0, 0]) == pytest.approx(0.0, abs=1e-9)


@pytest.fixture(scope="module")
def told():
    return designed(LATE, LAGGING)


def test_commands_keep_every_limit_under_every_answer(told):
    assert np.abs(told.commands.actions).max() <= 1.8
    for one in (LATE, LAGGING):
        state = one.twin.infer(jnp.asarray(HANGING), one.twin.params)
        run = jax.jit(lambda s, a, t=one.twin: rollout(t, t.params, s, a))(
            state, jnp.asarray(told.commands.actions[0], jnp.float32)
        )
        assert np.abs(run.states.v).max() <= 8.0
    assert max(told.usage.values()) <= 0.9


def test_commands_are_smooth_enough_for_a_controller(told):
    """Below a tenth of the sampling rate, but for what bounded sines have of harmonics."""
    power = np.abs(np.fft.rfft(told.commands.actions[0, :, 0])) ** 2
    frequency = np.fft.rfftfreq(told.commands.n_steps, TWIN.dt)

    assert power[frequency > 0.2 / TWIN.dt].sum() < 0.05 * power.sum()


def test_late_and_lagging_motors_are_distinguished_and_the_hardest_pair_comes_first(told):
    assert told.decides and told.chance > 0.9 and told.needed <= 1.0
    assert [p.ratio for p in told.pairs] == sorted(p.ratio for p in told.pairs)
    assert "told apart" in told.sentence
    assert max(map(len, str(told).splitlines())) <= 80


def test_the_result_is_plain_data(told):
    plain = json.loads(json.dumps(told.to_dict(), allow_nan=False))

    assert plain["commands"] == told.commands.actions.tolist() and plain["decides"] is True


def recorded(twin, actions, seed=0):
    """What a machine like this twin would show under these commands, from rest."""
    rng = np.random.default_rng(seed)
    with jax.enable_x64(True):
        start = twin.infer(jnp.asarray(HANGING), twin.params)
        obs = rollout(twin, twin.params, start, jnp.asarray(actions)).obs
    noise = np.array([0.01, 0.01, 0.05]) * rng.standard_normal(obs.shape)
    return Trajectories.from_arrays([np.asarray(obs) + noise], [actions], dt=twin.dt)


@each((LATE, "action_delay.torque"), (LAGGING, "motor_lag.torque"))
def test_the_recording_that_was_asked_for_decides_for_what_is_true(true, name, told):
    known = left_open(LATE, LAGGING)
    # A delay of 0.05 s, or a lag of 0.07 s: not what the answers believe, but within what is open.
    (row,) = true.factor
    off = -0.01 if true is LATE else 0.01
    machine = true.twin.with_parameters(**{row: 0.06 + off})

    after = updated(known, recorded(machine, told.commands.actions[0]))

    assert after.settled and after.answers[0].name == name, after
    assert after.answers[0].twin.values[row] == pytest.approx(0.06 + off, abs=0.004)
    # The deviation was 0.01 s before.
    assert np.linalg.norm(after.answers[0].factor[row]) < 0.008


def test_what_no_recording_tells_stays_as_likely_as_it_was(told):
    after = updated(left_open(HEAVY, WEAK), recorded(HEAVY.twin, told.commands.actions[0]))

    # Both are fitted as well; what differs is how far each had to move, a standard deviation or so.
    assert not after.settled and after.weights.min() > 0.2


def test_recordings_of_another_machine_decide_nothing(told):
    with pytest.raises(CalibrationError, match="Choose the columns"):
        updated(
            left_open(LATE),
            Trajectories.from_arrays([np.zeros((9, 1))], [np.zeros((8, 1))], dt=0.05),
        )


def test_commands_are_written_for_a_controller_and_read_back(told, tmp_path):
    table = pandas.read_csv(told.save(tmp_path / "next.csv"))
    again = Trajectories.load(told.save(tmp_path / "next.npz"))

    assert list(table.columns[:3]) == ["recording", "time", "torque"]
    assert table["torque"].to_numpy() == pytest.approx(told.commands.actions[0, :, 0], rel=1e-6)
    assert again.actions.tolist() == told.commands.actions.tolist()
    with pytest.raises(ParameterError, match=r"\.csv or \.npz"):
        told.save(tmp_path / "next.txt")


def test_mass_and_gain_are_one_without_a_force_sensor():
    told = designed(HEAVY, WEAK)

    assert not told.decides and told.needed > 100
    assert "No recording within these limits" in told.sentence
    assert any("sensor of the actuator's force" in words for words in told.would_tell)


def test_where_one_pair_cannot_be_distinguished_the_others_are_counted(told):
    pair = lambda a, b, chance: Pair(a, b, 1.0, chance, 1.0 if chance > 0.5 else np.inf)  # noqa: E731
    pairs = [pair(a, b, 0.0) for a, b in (("mass", "gain"), ("gain", "mass"))]
    pairs += [pair(a, b, 1.0) for x in ("mass", "gain") for a, b in ((x, "lag"), ("lag", x))]
    some = dataclasses.replace(told, pairs=tuple(pairs), decides=False)

    assert "No recording within these limits tells mass from gain" in some.sentence
    assert some.sentence.endswith("Of 3 pairs of answers, it tells 2 apart.")
    assert "pairs of answers" not in dataclasses.replace(some, pairs=some.pairs[:2]).sentence


def test_one_answer_asks_for_narrower_parameters():
    told = designed(HEAVY._replace(factor={"mass": np.array([0.2])}))

    now, then = told.narrower["mass"]
    assert now == pytest.approx(0.2) and then < 0.2 * now
    assert told.information == pytest.approx(np.log(now / then), rel=1e-3)


def test_limits_that_the_start_breaks_are_reported():
    with pytest.raises(CalibrationError, match="velocity of hinge is taken to"):
        designed(LATE, LAGGING, start=[1.0, 0.0, 6.0], limits={"velocity": 1.0})


def test_a_diagnosis_that_looked_for_no_cause_has_nothing_to_ask_and_is_copied():
    nothing = copy.copy(Diagnosis("unknown", TWIN, TWIN, "", 0, unexplained="Degrees."))

    with pytest.raises(CalibrationError, match="no answers to choose between"):
        nothing.next_experiment(LIMITS)
    assert pickle.loads(pickle.dumps(dataclasses.replace(nothing, opened=lambda: 0))).opened is None


@pytest.mark.expensive  # a whole diagnosis, and a design for what it leaves open
def test_a_diagnosis_asks_for_what_would_decide_and_believes_in_all_of_it(tmp_path):
    data = measured(TWIN.with_parameters(mass=1.15), 8, 80, noise=0.01)
    kinds = [effects.TorqueGain, effects.ViscousFriction]
    found = diagnose(TWIN, data, effects=kinds, budget="quick", progress=False)
    assert found.verdict == "ambiguous", found

    asked = found.next_experiment(LIMITS, seconds=3.0, progress=False)
    belief = found.belief

    assert {"parameter.mass", "torque_gain.torque"} <= {*asked.answers}
    assert not asked.decides and any("force" in words for words in asked.would_tell)
    page = html.unescape(found.to_html(tmp_path / "page.html", experiment=asked).read_text())
    assert "What to record next" in page and asked.would_tell[0] in page
    assert asked.answers == belief.answers and sum(belief.weights) == pytest.approx(1.0)
    mass, gain = belief.answers.index("parameter.mass"), belief.answers.index("torque_gain.torque")
    values = dict(zip(belief.base.parameters, belief.draws.T, strict=True))
    heavy, weak = belief.origin == mass, belief.origin == gain
    # What was planted, and its reciprocal: within three of the errors that the data leave.
    for name, own, truth in (
        ("mass", heavy, 1.15),
        ("torque_gain.torque.gain", weak, 1.0 / 1.15),
    ):
        assert values[name][own].mean() == pytest.approx(truth, abs=0.03)
        assert values[name][own].std() < 0.03
    assert np.all(values["mass"][weak] == TWIN.values["mass"])
    first = found.findings[0]
    (own,) = (a for a in found.answers.answers if a.causes == (first.key,))
    for name, told in first.parameters.items():
        full = name if first.key.startswith("parameter") else f"{first.key}.{name}"
        assert np.linalg.norm(own.factor[full]) == pytest.approx(told.stderr, rel=0.01)
