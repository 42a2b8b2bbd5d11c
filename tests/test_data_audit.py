"""The audit finds each defect that was planted, and nothing in data that have none."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from measuring import measured

from sb3_hds import Trajectories, audit, twins
from sb3_hds.core import Channel, State
from sb3_hds.data import Finding
from sb3_hds.data.audit.velocity import velocity_pairs
from sb3_hds.effects import CoulombFriction
from sb3_hds.errors import TrajectoryError
from sb3_hds.sysid.checks.timing import align_velocities

pytestmark = pytest.mark.filterwarnings("ignore::sb3_hds.data.SamplingWarning")


@pytest.fixture(scope="module")
def data():
    return measured(twins.make("PendulumReal"), n_steps=200, noise=0.002)


def channels_of(name):
    return twins.make(name).channels


def kinds(found):
    return {type(finding).__name__ for finding in found.findings}


def only(found, kind):
    """The only finding of a kind, beside others."""
    [finding] = [f for f in found.findings if type(f).__name__ == kind]
    return finding


def changed(data, change):
    """The same data, each episode changed: (number, observations, actions) to the latter two."""
    episodes = [change(i, *map(np.copy, data.episode(i))) for i in range(len(data))]
    obs, actions = zip(*episodes, strict=True)
    return Trajectories.from_arrays(obs, actions, dt=data.dt)


def alone(obs):
    command = np.random.default_rng(1).standard_normal((len(obs) - 1, 1))
    return Trajectories.from_arrays([obs], [command], dt=0.01)


def logged(data, path, times=None):
    """The same data, read back from a CSV file, by default with exact stamps."""
    tables = []
    for i in range(len(data)):
        obs, actions = data.episode(i)
        t = data.dt * np.arange(len(obs)) if times is None else times(i, len(obs))
        rows = [np.full(len(obs), i), t, *obs.T, *np.vstack([actions, actions[-1:]]).T]
        tables.append(np.stack(rows, axis=1))
    obs, actions = [f"x{j}" for j in range(data.n_obs)], [f"u{j}" for j in range(data.n_act)]
    header = ",".join(["run", "t", *obs, *actions])
    np.savetxt(path, np.concatenate(tables), "%.17g", ",", header=header, comments="")
    columns = {"time": "t", "obs": obs, "actions": actions, "episode": "run"}
    return Trajectories.load(path, columns=columns | ({"dt": data.dt} if times else {}))


# Twins whose data neither end nor reach a limit, with a position, angles, and both; seed and noise.
@each(("PendulumReal", 1, 0.01), ("CartPole", 2, 0.01), ("Acrobot", 1, 0), ("MountainCar", 0, 0.01))
def test_clean_data_raise_no_alarm(name, seed, noise, tmp_path):
    exact = measured(twins.make(name), n_steps=200, seed=seed, share=0.5)

    def disturb(i, obs, actions):
        error = np.random.default_rng(i).standard_normal(obs.shape)
        return obs + noise * obs.std(0) * error, actions

    clean = changed(exact, disturb)
    found = audit(clean, twin=twins.make(name))
    from_file = audit(logged(clean, tmp_path / "log.csv"))

    assert found.findings == from_file.findings == ()
    assert found.usable and found.reason == "" and found.velocity_shift == {}
    assert found.corrected(clean) is clean


def test_jitter_is_found_and_says_how_much(data, tmp_path):
    rng = np.random.default_rng(0)

    def times(_, n):
        return np.cumsum(data.dt * rng.uniform(0.7, 1.3, n))

    [finding] = audit(logged(data, tmp_path / "log.csv", times=times)).findings

    assert type(finding).__name__ == "UnevenSampling"
    # Uniform over +-30 %: two thirds differ from the median by more than 10 %.
    assert finding.share == pytest.approx(2.0 / 3.0, abs=0.05)
    assert "log.csv, episode 0" in str(finding)


def test_defects_of_the_clock_are_found_where_they_are(data, tmp_path):
    def times(i, n):
        t = data.dt * np.arange(n)
        t[51] -= 0.6 * data.dt * (i == 1)
        t[100:] += 2.0 * data.dt * (i == 2)
        t[100:] += 3.0 * (i == 3)
        t[51:] -= data.dt * (i == 4)
        return t

    read = logged(data, tmp_path / "log.csv", times=times)
    found = audit(read)

    gap, stamp = only(found, "Gaps"), only(found, "RepeatedStamps")
    off, missing = only(found, "JitteredStamps"), only(found, "MissingRows")
    assert gap.longest == pytest.approx(3.0 + data.dt) and "episode 3, sample 703" in str(gap)
    assert stamp.n_rows == 1 and "episode 4, sample 855" in str(stamp)
    assert (off.n_rows, off.longest) == (1, pytest.approx(0.6 * data.dt))
    assert "2 rows" in str(missing) and "episode 2, sample 502" in str(missing)
    np.testing.assert_array_equal(read.episode(1)[0], data.episode(1)[0])


def some_held(k):
    return k - np.r_[False, np.random.default_rng(0).random(len(k) - 1) < 0.1]


@each(
    (some_held, slice(3), ["cos", "sin", "speed"], 0.1),
    (lambda k: k // 2 * 2, slice(3), ["cos", "sin", "speed"], 0.5),
    (lambda k: k // 4 * 4, [2], ["speed"], 0.75),
    ids=["some", "half the rate", "one channel"],
)
def test_repeated_samples_are_found(held, of, channels, share, data):
    def repeat(_, obs, actions):
        obs[:, of] = obs[held(np.arange(len(obs)))][:, of]
        return obs, actions

    finding = only(audit(changed(data, repeat), channels_of("PendulumReal")), "RepeatedSamples")

    assert [finding.channel, *finding.others] == channels
    assert finding.share == pytest.approx(share, abs=0.03)
    says = "All 3 channels repeat" if finding.at_once else "'speed' repeats its last value"
    assert says in str(finding) and "cos, sin" not in str(finding)


def test_many_channels_that_repeat_samples_are_one_finding():
    """Each at its own samples, next to one that does not."""
    rng = np.random.default_rng(0)
    k, obs = np.arange(500), []
    for i in range(6):
        held = k - np.r_[False, rng.random(499) < (0.05 + 0.02 * i)] * (i < 5)
        obs.append(np.sin(0.02 * held + i))
    data = Trajectories.from_arrays([np.stack(obs, 1)], [np.ones((499, 1))], dt=0.01)

    finding = only(audit(data, [Channel(name, "rad") for name in "abcdef"]), "RepeatedSamples")

    assert (finding.channel, finding.others, finding.at_once) == ("a", tuple("bcde"), False)
    assert finding.share == pytest.approx(0.13, abs=0.04)
    assert "a, b, c and 2 more repeat their last values while they move" in str(finding)


def test_an_encoder_that_moves_slowly_repeats_no_samples_even_after_interpolation(tmp_path):
    twin = twins.make("CartPole")
    smooth = measured(twin, n_steps=400, share=0.3)
    counts = changed(smooth, lambda i, obs, actions: (np.round(obs / 0.02) * 0.02, actions))
    read = logged(counts, tmp_path / "log.csv")

    for data in (counts, counts.resample(0.7 * twin.dt), read.resample(0.7 * twin.dt)):
        found = audit(data, channels_of("CartPole"))
        assert not kinds(found) & {"RepeatedSamples", "StuckChannel"}
        assert [c.resolution for c in found.channels] == pytest.approx([0.02] * 5)


def test_a_stuck_channel_is_named_with_its_samples(data):
    def stick(i, obs, actions):
        if i == 3:
            obs[60:130, 1] = obs[60, 1]
        return np.column_stack([obs, np.full(len(obs), 0.7)]), actions

    dead, stuck = audit(changed(data, stick), ["cos", "sin", "speed", "current"]).findings

    assert stuck.channel == "sin" and "trajectory 3, samples 60 to 129" in str(stuck)
    assert (dead.channel, dead.value, len(dead.places)) == ("current", 0.7, len(data))


def test_a_channel_that_is_cut_off_is_named_with_its_limit(data):
    limit = float(np.quantile(data.obs[..., 2], 0.9))

    def clip(_, obs, actions):
        obs[:, 2] = np.minimum(obs[:, 2], limit)
        return obs, actions

    finding = only(audit(changed(data, clip), channels_of("PendulumReal")), "SaturatedChannel")

    assert (finding.channel, finding.value) == ("speed", limit)
    assert finding.share == pytest.approx(0.1, abs=0.04)


def test_a_system_that_comes_to_rest_is_neither_stuck_nor_cut_off(data):
    def rest(_, obs, actions):
        decay = np.exp(-0.1 * np.arange(len(obs)))[:, None]
        return np.round(obs * decay, 3), actions

    # That one falls over within a second and stays as it is.
    over = measured(twins.make("InvertedPendulum"), n_steps=100)

    for found in (audit(changed(data, rest)), audit(over, channels_of("InvertedPendulum"))):
        assert not kinds(found) & {"StuckChannel", "SaturatedChannel", "ReinitialisedState"}


def joined(data, n=60):
    """Two episodes in each recording, as a logger writes that does not know of resets."""

    def join(i, obs, actions):
        other, _ = data.episode((i + 1) % len(data))
        return np.concatenate([obs[:n], other[:n]]), actions[: 2 * n - 1]

    return changed(data, join)


@pytest.mark.parametrize("name", ["CartPole", "Acrobot"])
def test_a_state_that_was_put_back_is_found_and_cut_out(name):
    recorded = joined(measured(twins.make(name), n_steps=200))

    found = audit(recorded, channels_of(name))
    corrected = found.corrected(recorded)

    finding = only(found, "ReinitialisedState")
    assert finding.to_start and {place.first for place in finding.places} == {60}
    # Where the first state of an episode is near by, it is no jump: not all of them can be seen.
    assert len(finding.places) >= 6
    cut = [place.trajectory for place in finding.places]
    assert corrected.lengths.tolist() == [
        n for i in range(len(recorded)) for n in ([59, 59] if i in cut else [119])
    ]
    assert "ReinitialisedState" not in kinds(audit(corrected, channels_of(name)))


def test_a_jump_in_resampled_rows_is_cut_without_the_sample_between(tmp_path):
    twin = twins.make("CartPole")
    recorded = joined(measured(twin, n_steps=200))
    read = logged(recorded, tmp_path / "log.csv", lambda _, n: twin.dt * (np.arange(n) * 1.07))

    found = audit(read)
    corrected = found.corrected(read)

    finding = only(found, "ReinitialisedState")
    assert all(place.first % 120 == 60 for place in finding.places)
    jumps = [np.abs(np.diff(part.obs[0, :, 0])).max() for part in corrected]
    assert max(jumps) < 0.5 * finding.size


@each((0, 0, 1, None), (200, 200, 1, None), (80, 90, 12, slice(84, 86)))
def test_values_beyond_all_measure_are_refused_by_name_and_cut_out(first, last, lost, also, data):
    def spoil(i, obs, actions):
        if i == 3:
            obs[first : last + 1, 2] = 1e6
        if i == 3 and also:
            obs[also, 0] = -1e6
        return obs, actions

    spoiled = changed(data, spoil)
    found = audit(spoiled, channels_of("PendulumReal"))
    better = found.corrected(spoiled)

    assert not found.usable and kinds(found) == {"Outliers"}
    [of_speed] = [f for f in found.findings if f.channel == "speed"]
    assert [(p.trajectory, p.first, p.last) for p in of_speed.places] == [(3, first, last)]
    assert "'speed' jumps to 1e+06" in str(of_speed)
    assert np.abs(better.obs).max() < 100.0 and better.n_steps == data.n_steps - lost
    assert audit(better).findings == ()


@pytest.mark.parametrize("what", ["a short blow", "it runs away", "an impact", "a tick at rest"])
def test_what_motion_makes_is_no_outlier_and_no_glitch(what):
    t = np.arange(60)

    def shape(i, obs, actions):
        if what == "a short blow" and i == 3:
            obs[200:260, 1] += 100.0 * np.exp(-t / 2.0)
        if what == "it runs away" and i == 3:
            obs[-60:, 1] += 1e3 * np.exp((t - 59.0) / 5.0)
        if what == "an impact":
            obs[200:, 1] *= -1.0
        if what == "a tick at rest":
            obs[:] = obs[0]
            obs[80:82, 1] += 1e-3
            obs[200, 0] += 1e-3
        return obs, actions

    assert not kinds(audit(changed(pendulum_data(), shape), KNOWN)) & {"Outliers", "Glitches"}


@pytest.mark.parametrize("lag", [-3, 1])
def test_a_velocity_that_comes_late_or_early_is_found_and_shifted(data, lag):
    def shift(_, obs, actions):
        k = np.arange(10, len(obs) - 10)
        obs[k, 2] = np.copy(obs[:, 2])[k - lag]
        return obs[k], actions[10 : len(obs) - 11]

    recorded, names = changed(data, shift), channels_of("PendulumReal")

    found = audit(recorded, names)
    corrected = found.corrected(recorded)

    finding = only(found, "VelocityShift")
    assert (finding.channel, finding.position) == ("speed", "cos, sin")
    # The twins integrate in sub-steps, so their own velocity is up to a tenth of a sample late.
    assert found.velocity_shift == {"speed": pytest.approx(lag * data.dt, abs=0.15 * data.dt)}
    assert ("lags" if lag > 0 else "leads") in str(finding)
    assert "VelocityShift" not in kinds(audit(corrected, names))
    with pytest.raises(TrajectoryError, match="not the data of this audit"):
        found.corrected(data)


@pytest.mark.parametrize(("lag", "seen"), [(0.65, False), (1.0, True), (-1.5, True)])
def test_a_lag_of_a_fraction_of_a_sample_is_left_alone(lag, seen):
    t = np.arange(3000.0)
    obs = np.stack([np.sin(0.1 * t), 10.0 * np.cos(0.1 * (t - lag))], axis=1)
    shift = audit(alone(obs), ["q", "v"]).velocity_shift
    assert shift == ({"v": pytest.approx(0.01 * lag, abs=2e-4)} if seen else {})


@each((90, {}), (130, {"v": pytest.approx(0.01, abs=5e-4)}))
def test_a_lag_of_data_too_short_to_tell_how_sure_it_is_is_none(n_rows, shift):
    t = np.arange(float(n_rows))
    obs = np.stack([np.sin(0.1 * t), 10.0 * np.cos(0.1 * (t - 1.0))], axis=1)

    assert audit(alone(obs), ["q", "v"]).velocity_shift == shift


def test_the_noise_of_a_system_that_sometimes_rests_is_measured():
    rng = np.random.default_rng(0)
    sigma = np.array([0.003, 0.05])
    t = 0.01 * np.arange(3000)
    q = np.where(t < 15.0, 0.0, 1.0 - np.cos(t - 15.0))
    v = np.where(t < 15.0, 0.0, np.sin(t - 15.0))
    obs = np.stack([q, v], axis=1) + sigma * rng.standard_normal((3000, 2))

    found = audit(alone(obs), ["q", "v"])

    assert found.stands_still == pytest.approx(0.5, abs=0.05) and found.usable
    # 125 windows of 12 rows: 1375 degrees of freedom, a standard error of 2 %.
    assert found.noise["q"] == pytest.approx(sigma[0], rel=0.08)
    assert found.noise["v"] == pytest.approx(sigma[1], rel=0.08)


@pytest.mark.parametrize("resolution", [0.0, 0.01])
def test_standing_still_is_not_usable_and_tells_the_noise(resolution):
    obs = 0.3 + 0.01 * np.random.default_rng(0).standard_normal((2, 500, 2))
    obs = np.round(obs / resolution) * resolution if resolution else obs

    found = audit(Trajectories.from_arrays(obs, np.zeros((2, 499, 1)), dt=0.01))
    nothing = audit(Trajectories.from_arrays(0.0 * obs, np.zeros((2, 499, 1)), dt=0.01))

    assert not found.usable and "stands still 100 % of the time" in found.reason
    assert found.noise["obs[0]"] == pytest.approx(0.01, rel=0.1)
    assert "usable: NO." in str(found) and found.to_dict()["usable"] is False
    assert "stands still 100 % of the time" in nothing.reason


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("n_steps", [1, 2, 41])
def test_the_shortest_data_are_not_usable_and_break_nothing(n_steps):
    obs = np.random.default_rng(0).standard_normal((2, n_steps + 1, 1))
    found = audit(Trajectories.from_arrays(obs, np.zeros((2, n_steps, 0)), dt=0.01))
    assert not found.usable and f"{2 * n_steps} steps in all; a verdict needs" in found.reason
    assert found.velocity_shift == {}


def test_motion_within_noise_is_not_usable_and_rest_most_of_the_time_is():
    rng, t = np.random.default_rng(0), 0.01 * np.arange(5000)
    small = np.where((t % 10.0) < 5.0, 0.0, 0.08 * np.sin(20.0 * t))
    within = np.stack([small, 3.0 * small], axis=1) + [0.01, 0.03] * rng.standard_normal((5000, 2))
    resting = np.where(t[:, None] > 43.0, np.stack([np.sin(t - 43.0), np.cos(t)], 1), 0.0)
    resting += 0.001 * rng.standard_normal(resting.shape)

    noisy, still = audit(alone(within)), audit(alone(resting))

    assert not noisy.usable and "times its noise" in noisy.reason
    assert still.usable and "MostlyStill" in kinds(still)


@each(
    # Interpolation makes it of a gain that nobody changed, and drift of a set point.
    (lambda obs, noise: 100.0 + 1e-13 * noise, "ConstantCommand", "is 100 throughout"),
    (lambda obs, noise: 100.0 + 0.4 * noise, "ConstantCommand", "between 99.6 and 100.4"),
    (lambda obs, noise: obs[:-1] @ [[0.3], [1.0], [-0.2]], "DependentCommand", "action[0]"),
)
def test_commands_without_information_of_their_own_are_found(command, kind, says, data):
    rng = np.random.default_rng(0)

    def commanded(_, obs, actions):
        return obs, command(obs, rng.uniform(-1.0, 1.0, actions.shape))

    found = audit(changed(data, commanded))

    assert kinds(found) == {kind} and found.usable and says in str(found.findings[0])


@pytest.mark.parametrize(("period", "n_strokes"), [(12.0, 22), (2.0, None)])
def test_motion_that_goes_to_and_fro_too_seldom_is_found(period, n_strokes):
    """Two recordings of five periods: each has a quarter, nine halves, and a quarter."""
    rng, time = np.random.default_rng(0), 0.02 * np.arange(3000)
    moves = np.stack([np.sin(2.0 * np.pi * time / period), time / time[-1]], 1)
    obs = moves + 0.01 * rng.standard_normal((2, 3000, 2))
    actions = rng.standard_normal((2, 2999, 1))
    recorded = Trajectories.from_arrays(obs, actions, dt=0.02, conditions=["light", "heavy"])

    found = audit(recorded, ["angle", "temperature"])

    assert found.usable and kinds(found) == ({"PoorExcitation"} if n_strokes else set())
    for finding in found.findings:
        assert (finding.channel, finding.n_strokes) == ("angle", n_strokes)
        assert "2 recordings under 2 conditions" in str(finding)


def test_it_prints_in_80_columns_and_is_plain_json(data):
    def spoil(i, obs, actions):
        obs[60:130, 1] = obs[60, 1]
        return obs, 0.0 * actions

    found = audit(changed(data, spoil), channels_of("PendulumReal"))

    assert max(map(len, str(found).splitlines())) <= 80
    plain = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert {f["kind"] for f in plain["findings"]} == kinds(found) and len(kinds(found)) == 2
    assert plain["channels"][2]["unit"] == "rad/s" and plain["findings"][0]["text"]
    for kind in Finding.__subclasses__():
        assert dataclasses.is_dataclass(kind) and kind.remedy.endswith(".")
        assert kind.sentence is not Finding.sentence


def test_names_and_twins_must_fit_the_channels(data):
    for names in (["q", "v"], ["q", "q", "v"]):
        with pytest.raises(TrajectoryError, match="a unique name"):
            audit(data, names)
    with pytest.raises(TrajectoryError, match="CartPole has 5 channels and 1 commands"):
        audit(data, twin=twins.make("CartPole"))


def pendulum_data(dt=0.01, noise=0.0, n=400):
    """Angle and speed of eight swings that differ in amplitude and frequency."""
    rng = np.random.default_rng(0)
    t = dt * np.arange(n + 1)
    recordings = []
    for w in np.linspace(3.0, 6.0, 8):
        angle = 0.8 * np.sin(w * t) + 0.4 * np.sin(0.37 * w * t + 1.0)
        speed = 0.8 * w * np.cos(w * t) + 0.4 * 0.37 * w * np.cos(0.37 * w * t + 1.0)
        both = np.stack([angle, speed], axis=1)
        recordings.append(both + noise * both.std(0) * rng.standard_normal(both.shape))
    actions = [rng.standard_normal((n, 1)) for _ in recordings]
    return Trajectories.from_arrays(recordings, actions, dt=dt)


KNOWN = (Channel("angle", "rad"), Channel("speed", "rad/s"))


@each(
    (KNOWN, 0.05, (180.0 / np.pi, 1.0), "as if 'angle' were in degrees"),
    (("angle", "speed"), 0.0, (1.0, 180.0 / np.pi), "as if 'speed' were in degrees"),
    (KNOWN, 0.05, (1.0, 30.0), "one of them is in other units."),
    (KNOWN, 0.0, (1.0, 30.0 / np.pi), "as if 'speed' were in revolutions per minute"),
    ("wrapped", 0.0, (180.0 / np.pi, 1.0), "as if 'angle' were in degrees"),
)
def test_a_position_in_other_units_than_its_velocity_is_refused(channels, noise, scales, says):
    data = changed(pendulum_data(noise=noise), lambda _, obs, actions: (obs * scales, actions))
    if channels == "wrapped":
        channels = KNOWN
        data = changed(data, lambda _, obs, u: (np.c_[obs[:, 0] % 360.0, obs[:, 1]], u))

    found = audit(data, channels)

    assert kinds(found) == {"OtherUnits"} and not found.usable and says in found.reason
    assert found.findings[0].factor == pytest.approx(scales[0] / scales[1], rel=0.1)


@pytest.mark.parametrize(("factor", "dt"), [(0.2, 0.01), (0.8, 0.2), (1.25, 0.05), (8.0, 0.2)])
def test_a_factor_that_a_scale_of_the_sensor_explains_is_left_to_it(factor, dt):
    data = changed(pendulum_data(dt), lambda _, obs, actions: (obs * [factor, 1.0], actions))
    assert "OtherUnits" not in kinds(audit(data, KNOWN)) | kinds(audit(data))


class Swinging(twins.FreePendulum):
    """A free pendulum that is let go far out."""

    def initial(self, key, params):
        q = jax.random.uniform(key, (1,), minval=0.6, maxval=1.4)
        return State(q, jnp.zeros_like(q), {})


PENDULUM = {"mass": 0.3, "com": 0.2, "inertia": 0.002, "observe": "q", "dt": 0.02}


@pytest.fixture(scope="module")
def swings():
    rubbing = Swinging(**PENDULUM).extend(CoulombFriction(0, tau_c=0.012))
    return measured(rubbing, n_steps=300, noise=0.003)


@pytest.fixture(scope="module")
def degrees(swings):
    return changed(swings, lambda _, obs, actions: (np.rad2deg(obs), actions))


@pytest.mark.parametrize("changes", [{}, {"mass": 0.6, "damping": 0.02}])
def test_an_angle_in_degrees_is_refused_if_the_twin_says_so(changes, swings, degrees, tmp_path):
    twin = twins.make("FreePendulum", **PENDULUM | changes)

    found = audit(degrees, twin=twin)

    assert not found.usable and kinds(found) == {"MistakenUnits"}
    assert "{column: hinge_position, unit: deg}" in found.reason
    assert audit(swings, twin=twin).usable and audit(degrees).usable
    # Of a log, the column.
    read = logged(degrees, tmp_path / "log.csv")
    assert "{column: x0, unit: deg}" in audit(read, twin=twin).reason
    # Under a twin that is all wrong, it is a caveat.
    found = audit(degrees, ["angle"], twins.make("FreePendulum", **PENDULUM, zero="up"))
    assert found.usable and kinds(found) == {"LikelyUnits"}
    assert "'angle' spans" in str(found) and "degrees" in str(found.findings[0])


def test_an_axis_in_millimetres_is_refused():
    force = 5.0 * np.sin(0.2 * np.random.default_rng(0).standard_normal((8, 200, 1)).cumsum(1))
    twin = twins.make("LinearAxis", mass=2.6)  # the real one has 2 kg
    clean = measured(twins.make("LinearAxis", mass=2.0), n_steps=200, commands=force)
    data = changed(clean, lambda _, obs, actions: (1e3 * obs, actions))

    assert "if it is in millimetres" in audit(data, twin=twin).reason
    assert audit(clean, twin=twin).usable


def test_a_joint_that_turns_many_times_is_in_the_right_unit():
    own = {"driven": True, "mass": 0.5, "com": 0.2, "inertia": 0.01}
    walk = 0.05 * np.random.default_rng(0).standard_normal((6, 300, 1)).cumsum(1)
    real, noise = twins.make("FreePendulum", damping=0.02, **own), np.array([1e-3, 2e-2])
    data = measured(real, n=6, n_steps=300, noise=noise, commands=2.0 + np.sin(walk))

    assert np.ptp(data.obs[..., 0]) > 20.0 * np.pi
    for changes in ({}, {"mass": 1.0}, {"zero": "up"}):
        found = audit(data, twin=twins.make("FreePendulum", **own | changes))
        assert not kinds(found) & {"MistakenUnits", "LikelyUnits", "OtherUnits"}


def differentiated(data, noise=0.0, digits=15):
    """Positions as an encoder reports them, and their backward differences."""
    rng = np.random.default_rng(0)

    def change(_, obs, actions):
        q = obs[:, 0] + noise * rng.standard_normal(len(obs))
        return np.stack([q[1:], np.diff(q) / data.dt], 1).round(digits), actions[1:]

    return changed(data, change)


@pytest.mark.parametrize("digits", [15, 4])
def test_a_backward_difference_is_recognised_and_offered_as_a_correction(digits):
    data = differentiated(pendulum_data(n=1000), noise=1e-4, digits=digits)

    found = audit(data, KNOWN)
    better = found.corrected(data)

    assert kinds(found) == {"BackwardDifference"} and found.usable
    assert found.velocity_shift == {"speed": 0.005} and "-5 ms" in found.corrections[0]
    central = np.gradient(better.obs[..., 0], 0.01, axis=1)[:, 1:-1]
    np.testing.assert_allclose(better.obs[:, 1:-1, 1], central, atol=0.02)
    # A speed that a sensor measures half a sample late is none.
    rng, t = np.random.default_rng(0), 0.01 * np.arange(1000)
    obs = np.stack([np.sin(3.0 * t), 3.0 * np.cos(3.0 * (t - 0.005))], 1)
    for noise in ([0.0, 0.0], [1e-4, 3e-2]):
        seen = obs + noise * rng.standard_normal(obs.shape)
        assert kinds(audit(alone(seen), KNOWN)) <= {"PoorExcitation"}


def test_a_backward_difference_is_distinguished_from_steps_of_a_twin_and_shifted_for_a_diagnosis():
    force = np.sin(0.2 * np.random.default_rng(0).standard_normal((8, 200, 1)).cumsum(1))
    twin = twins.make("LinearAxis")
    differences = differentiated(measured(twin, n_steps=200, commands=force))

    moved, words = align_velocities(twin, differences)

    assert "BackwardDifference" in kinds(audit(differences, twin=twin))
    # Without noise and without a twin, nobody knows.
    assert "BackwardDifference" not in kinds(audit(differences))
    assert len(words) == 1 and "it was moved back. No sensor delays it." in words[0]
    central = np.gradient(moved.obs[..., 0], twin.dt, axis=1)[:, 1:-1]
    np.testing.assert_allclose(moved.obs[:, 1:-1, 1], central, atol=5e-3)
    # A velocity that the twin computes in the same way stays.
    cart_pole = twins.make("CartPole")
    data = measured(cart_pole, n_steps=200)
    assert align_velocities(cart_pole, data) == (data, ())


def test_a_position_and_a_velocity_that_are_swapped_are_refused_if_units_tell():
    data = changed(pendulum_data(), lambda _, obs, actions: (obs[:, ::-1], actions))
    found = audit(data, KNOWN)
    assert kinds(found) == {"Swapped"} and not found.usable
    assert "'angle' should be a position" in found.reason and audit(data, ["a", "b"]).findings == ()


@pytest.mark.parametrize(("channel", "noise"), [(0, 0.01), (1, 0.0)])
def test_a_single_sample_that_jumps_away_and_back_is_refused_and_cut_out(channel, noise):
    def spoil(i, obs, actions):
        obs[100 + 10 * i, channel] += 3.0 * np.ptp(obs[:, channel])
        return obs, actions

    data = changed(pendulum_data(noise=noise), spoil)
    found = audit(data, KNOWN)
    better = found.corrected(data)

    [finding] = found.findings
    assert type(finding).__name__ == "Glitches" and not found.usable
    assert [p.first for p in finding.places] == [100 + 10 * i for i in range(8)]
    assert f"'{KNOWN[channel].name}' jumps to" in found.reason
    assert audit(better, KNOWN).findings == () and len(better) == 16


def test_velocities_of_long_data_are_compared_on_stretches():
    dt = 0.01
    t = dt * np.arange(400_000)
    q, late = np.sin(3.0 * t), 3.0 * np.cos(3.0 * (t - 2.0 * dt))
    data = Trajectories.from_arrays([np.stack([q, late], 1)], [np.zeros((len(t) - 1, 1))], dt=dt)

    (pair,) = velocity_pairs(data, ["q", "v"])

    assert pair.samples == pytest.approx(2.0, abs=1e-3)
    assert sum(len(v) for _, v in pair.signals) == 100_000
