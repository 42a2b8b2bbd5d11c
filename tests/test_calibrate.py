"""Estimates: right, as sure as they say, and honest where the data cannot tell."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from measuring import jumping, measured
from scipy.optimize import least_squares

from sb3_hds import effects, twins
from sb3_hds.core import Trajectories, rollout
from sb3_hds.errors import CalibrationError, TrajectoryError
from sb3_hds.sysid import calibrate

TRUTH = {"mass": 1.2, "damping": 0.05}
BELIEVED = twins.make("PendulumReal")
TRUE = BELIEVED.with_parameters(**TRUTH)
FREE = tuple(TRUTH)


# More than there are: so all are one program.
PADDED = {"free": FREE, "n_windows": 64}


@pytest.fixture(scope="module")
def noisy():
    return measured(TRUE, noise=0.02)


@pytest.fixture(scope="module")
def fit(noisy):
    return calibrate(BELIEVED, noisy, **PADDED)


def test_planted_parameters_are_found_within_three_standard_errors(fit):
    assert fit.converged and fit.caveats == ()
    for name, value in TRUTH.items():
        found = fit[name]
        assert abs(found.estimate - value) < 3.0 * found.stderr
        assert 0.0 < found.stderr < 0.01
        assert found.low < found.estimate < found.high
        assert fit.twin.values[name] == found.estimate
    np.testing.assert_allclose(fit.noise, 0.02, rtol=0.2)
    # Over a window, start states take up some of the noise.
    assert (fit.error_after < 1.1 * 0.02).all()
    assert fit.error_before[2] > 5.0 * fit.error_after[2]
    exact = calibrate(BELIEVED, measured(TRUE), **PADDED)
    assert [exact[name].estimate for name in FREE] == pytest.approx([*TRUTH.values()], rel=1e-6)


def test_names_are_printed_in_full_and_what_diverges_is_said(fit):
    name = "a_joint_with_a_rather_long_name_damping"
    (first, *rest), before = fit.estimates, np.array([np.nan, *fit.error_before[1:]])
    long = (dataclasses.replace(first, name=name), *rest)
    text = repr(dataclasses.replace(fit, estimates=long, error_before=before))

    assert f"\n{name} " in text and text.count("diverges") == 1 and "nan" not in text


def test_what_happened_before_a_window_counts():
    axis = twins.make("LinearAxis", dt=0.02, damping=3.0)
    late = axis.extend(effects.ActionDelay(delay=0.05))
    data = measured(late, n=4, noise=0.002, commands=jumping(4))
    (name,) = set(late.params) - set(axis.params)

    found = calibrate(axis.extend(effects.ActionDelay()), data, free=[name])[name]

    assert abs(found.estimate - 0.05) < 3.0 * found.stderr < 0.003


def test_it_agrees_with_scipy_on_the_complete_problem(x64):
    """Parameters and start states together, by another solver, without elimination."""
    data = measured(TRUE, n=3, n_steps=21, noise=0.02)
    fit = calibrate(BELIEVED, data, window=10, loss="linear", **PADDED)
    windows = data.windows(10, 11)
    twin, noise = BELIEVED, jnp.asarray(fit.noise)
    assert fit.n_windows == len(windows)

    @jax.jit
    def errors(unknown):
        params = twin.params | dict(zip(FREE, unknown[: len(FREE)], strict=True))
        offsets = unknown[len(FREE) :].reshape(len(windows), 2)

        def one(obs, actions, offset):
            start = twin.infer(obs[0], params)
            start = start._replace(q=start.q + offset[:1], v=start.v + offset[1:])
            return (rollout(twin, params, start, actions).obs - obs) / noise

        return jax.vmap(one)(windows.obs, windows.actions, offsets).ravel()

    begin = np.concatenate([[1.0, 0.0], np.zeros(2 * len(windows))])
    found = least_squares(errors, begin, jac=jax.jit(jax.jacfwd(errors)), xtol=1e-12, ftol=1e-12)

    ours = [fit[name].estimate for name in FREE]
    # To a hundredth of a standard error.
    np.testing.assert_allclose(ours, found.x[: len(FREE)], rtol=1e-4, atol=3e-5)
    # Ours is a sandwich, whose deviations scatter by some 30 % over these few windows.
    spread = np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)))[: len(FREE)]
    np.testing.assert_allclose([fit[name].stderr for name in FREE], spread, rtol=0.5)


def test_outliers_count_less():
    data = measured(TRUE, noise=0.01)
    obs = data.obs.copy()
    hit = np.random.default_rng(1).random(obs.shape) < 0.01
    obs[hit] += 3.0
    spoiled = Trajectories.from_arrays(obs, data.actions, dt=data.dt)

    robust, plain = (calibrate(BELIEVED, spoiled, loss=k, **PADDED) for k in ("huber", "linear"))

    missed = [sum(abs(f[name].estimate - v) for name, v in TRUTH.items()) for f in (robust, plain)]
    assert missed[0] < 0.02
    assert missed[0] < 0.5 * missed[1]


def test_a_bound_is_kept_and_said():
    """Here is no damping, so noise pushes the estimate below zero half of the time."""
    fits = [
        calibrate(BELIEVED, measured(BELIEVED, n=2, noise=0.05, seed=seed), **PADDED)
        for seed in range(3)
    ]

    assert all(fit["damping"].estimate >= 0.0 and fit["damping"].low >= 0.0 for fit in fits)
    assert any(fit["damping"].at_bound for fit in fits)
    (caveat,) = next(fit.caveats for fit in fits if fit["damping"].at_bound)
    assert "physical bound: damping" in caveat


def test_what_the_data_do_not_determine_is_said():
    """Torques are known, so inertia and weight are: three numbers of two cannot be told apart."""
    free, data = ("mass", "length", "gravity"), measured(BELIEVED, n=4, noise=0.02)

    fit = calibrate(BELIEVED, data, free=free)

    assert len(fit.undetermined) == 1
    assert np.isinf([e.stderr for e in fit.estimates]).any()
    assert any("only combinations" in caveat for caveat in fit.caveats)
    believed = calibrate(BELIEVED, data, free=free, prior=1.0)
    assert believed.undetermined == ()
    for e in believed.estimates:
        scale = believed.twin.parameters[e.name].scale
        assert 0.01 * scale < e.stderr < 1.5 * scale
        assert e.low < e.before < e.high


def test_it_prints_itself_and_is_plain_data(fit, tmp_path):
    assert "mass" in str(fit) and "kg" in str(fit)
    plain = json.loads(json.dumps(fit.to_dict(), allow_nan=False))
    assert plain["estimates"][0]["name"] == "mass"
    fit.plot(tmp_path / "fit.png")
    assert (tmp_path / "fit.png").stat().st_size > 10_000
    with pytest.raises(KeyError, match="'gravity' was not free"):
        fit["gravity"]


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"free": ["weight"]}, CalibrationError, r"free must name parameters .*gravity, mass"),
        ({"free": ["mass", "mass"]}, CalibrationError, "each once"),
        ({"loss": "cauchy"}, CalibrationError, "'huber' or 'linear'"),
        ({"n_windows": 0}, CalibrationError, "n_windows must be at least 1"),
        ({"level": 1.5}, CalibrationError, "level must lie"),
        ({"twin": twins.make("CartPole")}, CalibrationError, "observes 5 channels"),
        ({"twin": twins.make("PendulumReal", dt=0.02)}, CalibrationError, r"resample\(dt=0\.02\)"),
        ({"window": 500}, TrajectoryError, "shorter windows"),
        ({"rows": 1}, CalibrationError, "unknowns"),
    ],
)
def test_what_cannot_be_estimated_is_refused(noisy, change, error, message):
    given = {"twin": BELIEVED} | change
    data = noisy.windows(1)[: given.pop("rows")] if "rows" in given else noisy

    with pytest.raises(error, match=message):
        calibrate(given.pop("twin"), data, **given)


@pytest.mark.expensive
def test_intervals_cover_the_truth_as_often_as_they_say():
    """80 seeds; at 95 %, fewer than 69 would be chance once in a thousand."""
    hits = {name: 0 for name in FREE}
    for seed in range(80):
        fit = calibrate(BELIEVED, measured(TRUE, n=20, noise=0.02, seed=seed), free=FREE)
        for name, value in TRUTH.items():
            hits[name] += fit[name].low <= value <= fit[name].high
    assert all(n >= 69 for n in hits.values()), hits
