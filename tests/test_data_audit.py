"""The audit finds each defect that was planted, and nothing in data that have none."""

import dataclasses
import json

import numpy as np
import pytest
from measuring import measured

from sb3_hds import Trajectories, audit, twins
from sb3_hds.core import Channel
from sb3_hds.data import Finding, SamplingWarning
from sb3_hds.errors import TrajectoryError

pytestmark = pytest.mark.usefixtures("quick_compilation")

# Twins whose data neither end nor reach a limit, with a position, angles, and both.
CLEAN = ("PendulumReal", "CartPole", "Acrobot", "PayloadPendulum", "MountainCar")


@pytest.fixture(scope="module")
def data():
    return measured(twins.make("PendulumReal"), n_steps=200, noise=0.002)


def channels_of(name):
    return twins.make(name).channels


def kinds(found):
    return {type(finding).__name__ for finding in found.findings}


def changed(data, change):
    """The same data, each episode changed: (number, observations, actions) to the latter two."""
    episodes = [change(i, *map(np.copy, data.episode(i))) for i in range(len(data))]
    obs, actions = zip(*episodes, strict=True)
    return Trajectories.from_arrays(obs, actions, dt=data.dt)


def logged(data, path, warns=True, times=None):
    """The same data, read back from a CSV file, by default with exact stamps."""
    tables = []
    for i in range(len(data)):
        obs, actions = data.episode(i)
        t = data.dt * np.arange(len(obs)) if times is None else times(i, len(obs))
        rows = [np.full(len(obs), i), t, *obs.T, *np.vstack([actions, actions[-1:]]).T]
        tables.append(np.stack(rows, axis=1))
    obs, actions = (
        [f"{k}{j}" for j in range(n)] for k, n in (("x", data.n_obs), ("u", data.n_act))
    )
    header = ",".join(["run", "t", *obs, *actions])
    np.savetxt(path, np.concatenate(tables), "%.17g", ",", header=header, comments="")
    columns = {"time": "t", "obs": obs, "actions": actions, "episode": "run"}
    if warns:
        with pytest.warns(SamplingWarning):
            return Trajectories.load(path, columns=columns | {"dt": data.dt})
    return Trajectories.load(path, columns=columns)


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("name", CLEAN)
def test_clean_data_raise_no_alarm(name, seed, noise, tmp_path):
    exact = measured(twins.make(name), n_steps=200, seed=seed, share=0.5)
    sigma = noise * exact.obs.std(axis=(0, 1))
    clean = measured(twins.make(name), n_steps=200, noise=sigma, seed=seed, share=0.5)

    found = audit(clean, channels_of(name))
    assert audit(clean, twin=twins.make(name)) == found
    from_file = audit(logged(clean, tmp_path / "log.csv", warns=False))

    assert found.findings == from_file.findings == ()
    assert found.usable and found.reason == "" and found.velocity_shift == {}
    assert found.corrected(clean) is clean


# --- time


def test_jitter_is_found_and_says_how_much(data, tmp_path):
    rng = np.random.default_rng(0)

    def times(_, n):
        return np.cumsum(data.dt * rng.uniform(0.7, 1.3, n))

    [finding] = audit(logged(data, tmp_path / "log.csv", times=times)).findings

    assert kinds(audit(logged(data, tmp_path / "log.csv", times=times))) == {"UnevenSampling"}
    # Uniform over +-30 %: two thirds differ from the median by more than 10 %.
    assert finding.share == pytest.approx(2.0 / 3.0, abs=0.05)
    assert "log.csv, episode 0" in str(finding) and "ms apart" in str(finding)


def test_gaps_and_repeated_stamps_are_found_where_they_are(data, tmp_path):
    def times(i, n):
        t = data.dt * np.arange(n)
        t[100:] += 3.0 * (i == 2)
        t[51:] -= data.dt * (i == 4)
        return t

    found = audit(logged(data, tmp_path / "log.csv", times=times))

    [gap] = [f for f in found.findings if type(f).__name__ == "Gaps"]
    [stamp] = [f for f in found.findings if type(f).__name__ == "RepeatedStamps"]
    assert gap.longest == pytest.approx(3.0 + data.dt) and "episode 2, sample 502" in str(gap)
    assert stamp.n_rows == 1 and "episode 4, sample 855" in str(stamp)


def test_stamps_that_are_off_and_rows_that_are_missing_are_found_where_they_are(data, tmp_path):
    def times(i, n):
        t = data.dt * np.arange(n)
        t[51] -= 0.6 * data.dt * (i == 4)
        t[100:] += 2.0 * data.dt * (i == 2)
        return t

    read = logged(data, tmp_path / "log.csv", times=times)
    off, missing = audit(read).findings

    assert (type(off).__name__, type(missing).__name__) == ("JitteredStamps", "MissingRows")
    assert (off.n_rows, off.longest) == (1, pytest.approx(0.6 * data.dt))
    assert "1 time stamp is off by up to 30 ms" in str(off) and "episode 4, sample 855" in str(off)
    assert "2 rows of a regular clock are missing, before log.csv, episode 2, sample 502" in str(
        missing
    )
    np.testing.assert_array_equal(read.episode(4)[0], data.episode(4)[0])


@pytest.mark.parametrize("how", ["hold", "insert", "half the rate"])
def test_repeated_samples_are_found(data, how):
    rng = np.random.default_rng(0)

    def repeat(_, obs, actions):
        k = np.arange(len(obs))
        if how == "hold":
            k[1:] -= rng.random(len(k) - 1) < 0.1
        elif how == "insert":
            k = np.repeat(k, 1 + (rng.random(len(k)) < 0.1))[: len(k)]
        else:
            k = k // 2 * 2
        return obs[k], actions

    found = audit(changed(data, repeat), channels_of("PendulumReal"))

    [finding] = [f for f in found.findings if type(f).__name__ == "RepeatedSamples"]
    assert finding.channel == "cos, sin, speed"
    assert finding.share == pytest.approx(0.5 if how == "half the rate" else 0.1, abs=0.03)


def test_one_channel_that_is_sampled_more_slowly_is_named(data):
    def slow(_, obs, actions):
        obs[:, 2] = obs[np.arange(len(obs)) // 4 * 4, 2]
        return obs, actions

    found = audit(changed(data, slow), channels_of("PendulumReal"))

    [finding] = [f for f in found.findings if type(f).__name__ == "RepeatedSamples"]
    assert finding.channel == "speed" and finding.share == pytest.approx(0.75, abs=0.02)


def test_an_encoder_that_moves_slowly_repeats_no_samples(data):
    def counts(_, obs, actions):
        return np.round(obs / 0.02) * 0.02, actions

    found = audit(changed(data, counts), channels_of("PendulumReal"))

    assert "RepeatedSamples" not in kinds(found) and "StuckChannel" not in kinds(found)
    assert [c.resolution for c in found.channels] == pytest.approx([0.02] * 3)


def test_an_encoder_is_recognised_after_interpolation(tmp_path):
    twin = twins.make("CartPole")
    smooth = measured(twin, n_steps=400, share=0.3)
    counts = changed(smooth, lambda i, obs, actions: (np.round(obs / 0.02) * 0.02, actions))

    for data in (counts, logged(counts, tmp_path / "log.csv", warns=False)):
        found = audit(data.resample(0.7 * twin.dt), channels_of("CartPole"))
        assert "RepeatedSamples" not in kinds(found)
        assert [c.resolution for c in found.channels] == pytest.approx([0.02] * 5)


# --- channels


def test_a_stuck_channel_is_named_with_its_samples(data):
    def stick(i, obs, actions):
        if i == 3:
            obs[60:130, 1] = obs[60, 1]
        return obs, actions

    found = audit(changed(data, stick), channels_of("PendulumReal"))

    [finding] = [f for f in found.findings if type(f).__name__ == "StuckChannel"]
    assert str(finding).startswith("'sin' stays at exactly")
    assert "trajectory 3, samples 60 to 129" in str(finding)


def test_a_channel_that_never_changes_is_stuck(data):
    def dead(_, obs, actions):
        return np.column_stack([obs, np.full(len(obs), 0.7)]), actions

    found = audit(changed(data, dead), ["cos", "sin", "speed", "current"])

    [finding] = found.findings
    assert (finding.channel, finding.value, len(finding.places)) == ("current", 0.7, len(data))


@pytest.mark.parametrize("channel", [0, 1, 2])
def test_a_channel_that_is_cut_off_is_named_with_its_limit(data, channel):
    limit = float(np.quantile(data.obs[..., channel], 0.9))

    def clip(_, obs, actions):
        obs[:, channel] = np.minimum(obs[:, channel], limit)
        return obs, actions

    found = audit(changed(data, clip), channels_of("PendulumReal"))

    [finding] = [f for f in found.findings if type(f).__name__ == "SaturatedChannel"]
    assert (finding.channel, finding.value) == (found.channels[channel].name, limit)
    assert finding.share == pytest.approx(0.1, abs=0.04)


def test_a_system_that_comes_to_rest_is_neither_stuck_nor_cut_off(data):
    def rest(_, obs, actions):
        decay = np.exp(-0.1 * np.arange(len(obs)))[:, None]
        return np.round(obs * decay, 3), actions

    found = audit(changed(data, rest), channels_of("PendulumReal"))

    assert not kinds(found) & {"StuckChannel", "SaturatedChannel", "ReinitialisedState"}


def test_an_episode_that_ends_at_once_and_is_recorded_on_is_neither():
    twin = twins.make("InvertedPendulum")  # falls over within a second and stays as it is

    found = audit(measured(twin, n_steps=100), twin.channels)

    assert not kinds(found) & {"StuckChannel", "SaturatedChannel", "ReinitialisedState"}


# --- episodes that were not told apart


def joined(data, n=60):
    """Two episodes in each recording, as a logger writes that does not know of resets."""

    def join(i, obs, actions):
        other, _ = data.episode((i + 1) % len(data))
        return np.concatenate([obs[:n], other[:n]]), actions[: 2 * n - 1]

    return changed(data, join)


@pytest.mark.parametrize("name", ["PendulumReal", "CartPole", "MountainCar", "Acrobot"])
def test_a_state_that_was_put_back_is_found_and_cut_out(name):
    recorded = joined(measured(twins.make(name), n_steps=200))

    found = audit(recorded, channels_of(name))
    corrected = found.corrected(recorded)

    [finding] = [f for f in found.findings if type(f).__name__ == "ReinitialisedState"]
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
    read = logged(
        recorded, tmp_path / "log.csv", times=lambda _, n: twin.dt * (np.arange(n) * 1.07)
    )

    found = audit(read)
    corrected = found.corrected(read)

    [finding] = [f for f in found.findings if type(f).__name__ == "ReinitialisedState"]
    assert all(place.first % 120 == 60 for place in finding.places)
    assert "ReinitialisedState" not in kinds(audit(corrected))
    largest = max(
        np.abs(np.diff(corrected.episode(i)[0][:, 0])).max() for i in range(len(corrected))
    )
    assert largest < 0.5 * finding.size


# --- velocities


@pytest.mark.parametrize("first, last", [(0, 0), (80, 80), (80, 90), (200, 200)])
def test_values_beyond_all_measure_are_refused_by_name_and_cut_out(data, first, last):
    def spoil(i, obs, actions):
        if i == 3:
            obs[first : last + 1, 2] = 1e6
        return obs, actions

    spoiled = changed(data, spoil)
    found = audit(spoiled, channels_of("PendulumReal"))
    better = found.corrected(spoiled)

    assert kinds(found) == {"Outliers"} and not found.usable
    assert f"'{channels_of('PendulumReal')[2].name}' jumps to 1e+06 and back" in found.reason
    assert [(p.trajectory, p.first, p.last) for p in found.findings[0].places] == [(3, first, last)]
    assert audit(better).findings == () and np.abs(better.obs).max() < 100.0
    lost = {(0, 0): 1, (80, 80): 2, (80, 90): 12, (200, 200): 1}[first, last]
    assert better.n_steps == data.n_steps - lost


def test_outliers_of_two_channels_at_once_are_cut_out_together(data):
    def spoil(i, obs, actions):
        if i == 3:
            obs[80:91, 2] = 1e6
            obs[84:86, 0] = -1e6
        return obs, actions

    spoiled = changed(data, spoil)
    better = audit(spoiled).corrected(spoiled)

    assert np.abs(better.obs).max() < 100.0 and better.n_steps == data.n_steps - 12


@pytest.mark.parametrize("what", ["a blow", "it runs away", "a rest with an encoder's steps"])
def test_what_is_large_and_real_is_no_outlier(data, what):
    t = np.arange(60)

    def shape(i, obs, actions):
        if what == "a blow" and i == 3:
            obs[80:140, 2] += 1e3 * np.exp(-t / 5.0)
        if what == "it runs away" and i == 3:
            obs[-60:, 2] += 1e3 * np.exp((t - 59.0) / 5.0)
        if what == "a rest with an encoder's steps":
            obs[:] = obs[0]
            obs[80:82, 2] += 1e-3
        return obs, actions

    assert "Outliers" not in kinds(audit(changed(data, shape)))


def test_a_single_channel_that_is_cut_off_where_it_began_was_not_put_back():
    starts, t = np.linspace(1.0, 2.0, 8), 0.4 * np.arange(201)
    only = [np.minimum(np.sin(t + start), 0.3)[:, None] for start in starts]
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (8, 200, 1))

    found = audit(Trajectories.from_arrays(only, actions, dt=0.05))

    assert "SaturatedChannel" in kinds(found) and "ReinitialisedState" not in kinds(found)


def late(data, channel, lag):
    """A channel that comes late by a whole number of samples; the ends are cut off."""

    def shift(_, obs, actions):
        k = np.arange(10, len(obs) - 10)
        obs[k, channel] = np.copy(obs[:, channel])[k - lag]
        return obs[k], actions[10 : len(obs) - 11]

    return changed(data, shift)


@pytest.mark.parametrize("lag", [-3, -1, 1, 2, 6])
@pytest.mark.parametrize(
    ("name", "channel", "position"),
    [
        ("PendulumReal", 2, "cos, sin"),
        ("PayloadPendulum", 4, "x"),
    ],
)
def test_a_velocity_that_comes_late_or_early_is_found_and_shifted(name, channel, position, lag):
    twin = twins.make(name)
    clean = measured(twin, n_steps=200)
    recorded = late(clean, channel, lag)

    found = audit(recorded, twin.channels)
    corrected = found.corrected(recorded)

    [finding] = [f for f in found.findings if type(f).__name__ == "VelocityShift"]
    assert (finding.channel, finding.position) == (twin.channels[channel].name, position)
    # The twins integrate in sub-steps, so their own velocity is up to a tenth of a sample late.
    assert finding.samples == pytest.approx(lag, abs=0.15)
    assert found.velocity_shift == {
        finding.channel: pytest.approx(lag * twin.dt, abs=0.15 * twin.dt)
    }
    assert ("lags" if lag > 0 else "leads") in str(finding)
    assert "VelocityShift" not in kinds(audit(corrected, twin.channels))
    truth = np.stack([clean.episode(i)[0][10:-10] for i in range(len(clean))])
    first = max(0, int(np.ceil(-finding.samples)))  # sample of the truth that is now the first one
    after = corrected.obs - truth[:, first : first + corrected.obs.shape[1]]
    before = recorded.obs - truth
    # Interpolation and the twin's own tenth of a sample are left.
    assert after[..., channel].std() < 0.35 * before[..., channel].std()


def test_half_a_sample_of_a_backward_difference_is_no_shift():
    clean = measured(twins.make("CartPole"), n_steps=200)  # semi-implicit Euler: v late by dt / 2

    assert audit(clean, channels_of("CartPole")).velocity_shift == {}


@pytest.mark.parametrize(("lag", "seen"), [(0.65, False), (1.0, True), (-1.5, True)])
def test_a_lag_of_a_fraction_of_a_sample_is_left_alone(lag, seen):
    t = np.arange(3000.0)
    obs = np.stack([np.sin(0.1 * t), 10.0 * np.cos(0.1 * (t - lag))], axis=1)
    recorded = Trajectories.from_arrays([obs], [np.sin(t[:-1])[:, None] ** 3], dt=0.01)

    shift = audit(recorded, ["q", "v"]).velocity_shift

    assert shift == ({"v": pytest.approx(0.01 * lag, abs=2e-4)} if seen else {})


def test_a_shift_longer_than_an_episode_is_refused(data):
    recorded = late(data, 2, 3)
    found = audit(recorded, channels_of("PendulumReal"))
    short = dataclasses.replace(found, lengths=tuple(recorded.windows(2).lengths.tolist()))

    with pytest.raises(TrajectoryError, match="Trajectory 0 has 2 steps, too few for shifts"):
        short.corrected(recorded.windows(2))
    with pytest.raises(TrajectoryError, match="These are not the data of this audit"):
        found.corrected(data)


# --- motion


def test_the_noise_of_a_system_that_sometimes_rests_is_measured():
    rng = np.random.default_rng(0)
    sigma = np.array([0.003, 0.05])
    t = 0.01 * np.arange(3000)
    q = np.where(t < 15.0, 0.0, 1.0 - np.cos(t - 15.0))
    v = np.where(t < 15.0, 0.0, np.sin(t - 15.0))
    obs = np.stack([q, v], axis=1) + sigma * rng.standard_normal((3000, 2))
    recorded = Trajectories.from_arrays([obs], [rng.standard_normal((2999, 1))], dt=0.01)

    found = audit(recorded, ["q", "v"])

    assert found.stands_still == pytest.approx(0.5, abs=0.05) and found.usable
    # 125 windows of 12 rows: 1375 degrees of freedom, a standard error of 2 %.
    assert found.noise["q"] == pytest.approx(sigma[0], rel=0.08)
    assert found.noise["v"] == pytest.approx(sigma[1], rel=0.08)


def test_the_noise_is_unknown_where_nothing_rests(data):
    assert set(audit(data, channels_of("PendulumReal")).noise.values()) == {None}


@pytest.mark.parametrize("resolution", [0.0, 0.01])
def test_standing_still_is_not_usable_and_tells_the_noise(resolution):
    obs = 0.3 + 0.01 * np.random.default_rng(0).standard_normal((2, 500, 2))
    obs = np.round(obs / resolution) * resolution if resolution else obs
    recorded = Trajectories.from_arrays(obs, np.zeros((2, 499, 1)), dt=0.01)

    found = audit(recorded)

    assert not found.usable and "stands still 100 % of the time" in found.reason
    assert found.noise["obs[0]"] == pytest.approx(0.01, rel=0.1)
    assert "usable: NO." in str(found) and found.to_dict()["usable"] is False


def test_a_recording_of_nothing_at_all_is_not_usable():
    recorded = Trajectories.from_arrays(np.zeros((1, 300, 2)), np.zeros((1, 299, 1)), dt=0.01)

    assert "stands still 100 % of the time" in audit(recorded).reason


def test_too_few_steps_are_not_usable(data):
    found = audit(data.windows(20)[:3], channels_of("PendulumReal"))

    assert not found.usable
    assert found.reason == (
        "There are 60 steps in all; a verdict needs 100 at least. Record longer, or more often."
    )


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("n_steps", [1, 2, 5])
def test_the_shortest_data_are_not_usable_and_break_nothing(n_steps):
    obs = np.random.default_rng(0).standard_normal((2, n_steps + 1, 1))

    found = audit(Trajectories.from_arrays(obs, np.zeros((2, n_steps, 0)), dt=0.01))

    assert not found.usable and found.to_dict()["n_steps"] == 2 * n_steps


def test_motion_within_noise_is_not_usable():
    rng = np.random.default_rng(0)
    t = 0.01 * np.arange(3000)
    rest = np.where((t % 10.0) < 5.0, 0.0, 0.08 * np.sin(20.0 * t))
    obs = np.stack([rest, 3.0 * rest], axis=1) + np.array([0.01, 0.03]) * rng.standard_normal(
        (3000, 2)
    )
    recorded = Trajectories.from_arrays([obs], [rng.standard_normal((2999, 1))], dt=0.01)

    found = audit(recorded)

    assert not found.usable and "times its noise" in found.reason


def test_mostly_resting_data_are_usable_with_a_warning():
    rng = np.random.default_rng(0)
    t = 0.01 * np.arange(5000)
    moving = t > 43.0
    obs = np.stack([np.where(moving, np.sin(t - 43.0), 0.0), np.where(moving, np.cos(t), 0.0)], 1)
    obs += 0.001 * rng.standard_normal(obs.shape)
    recorded = Trajectories.from_arrays([obs], [rng.standard_normal((4999, 1))], dt=0.01)

    found = audit(recorded)

    assert found.usable and "MostlyStill" in kinds(found)


def test_a_command_that_never_changes_is_found(data):
    found = audit(changed(data, lambda i, obs, actions: (obs, 0.0 * actions + 0.4)))

    assert kinds(found) == {"ConstantCommand"} and found.usable
    assert "'action[0]' is 0.4 throughout" in str(found.findings[0])


@pytest.mark.parametrize(
    ("spread", "said"), [(1e-13, "is 100 throughout"), (0.4, "is between 99.6 and 100.4")]
)
def test_a_command_that_hardly_varies_is_found(data, spread, said):
    """Interpolation makes it of a gain that nobody changed, and drift of a set point."""
    rng = np.random.default_rng(0)

    def nearly_constant(_, obs, actions):
        return obs, 100.0 + spread * rng.uniform(-1.0, 1.0, actions.shape)

    found = audit(changed(data, nearly_constant))

    assert kinds(found) == {"ConstantCommand"}
    assert said in str(found.findings[0])


@pytest.mark.parametrize(("period", "n_strokes"), [(12.0, 22), (2.0, None)])
def test_motion_that_goes_to_and_fro_too_seldom_is_found(period, n_strokes):
    """Two recordings of five periods: each has a quarter, nine halves, and a quarter."""
    rng, dt = np.random.default_rng(0), 0.02
    time = dt * np.arange(3000)
    obs, actions = [], []
    for _ in range(2):
        slow = np.sin(2.0 * np.pi * time / period)
        drift = time / time[-1]
        obs.append(np.stack([slow, drift], 1) + 0.01 * rng.standard_normal((3000, 2)))
        actions.append(rng.standard_normal((2999, 1)))
    recorded = Trajectories.from_arrays(obs, actions, dt=dt, conditions=["light", "heavy"])

    found = audit(recorded, ["angle", "temperature"])

    if n_strokes is None:
        assert found.findings == ()
        return
    (finding,) = found.findings
    assert (finding.channel, finding.n_strokes, finding.n_conditions) == ("angle", n_strokes, 2)
    assert "Excitation is poor" in str(finding) and "'angle'" in str(finding)
    assert "Record more strokes" in str(finding) and "2 recordings under 2 conditions" in str(
        finding
    )
    assert found.usable


def test_a_command_that_follows_from_the_observations_is_found(data):
    found = audit(changed(data, lambda i, obs, actions: (obs, obs[:-1] @ [[0.3], [1.0], [-0.2]])))

    assert kinds(found) == {"DependentCommand"}
    assert found.findings[0].r2 == pytest.approx(1.0)


# --- the result


def test_it_prints_in_80_columns_and_is_plain_json(data, tmp_path):
    def spoil(i, obs, actions):
        obs[60:130, 1] = obs[60, 1]
        return obs, 0.0 * actions

    rng = np.random.default_rng(0)
    spoilt = logged(
        changed(data, spoil),
        tmp_path / f"{'a_long_name_' * 5}.csv",
        times=lambda _, n: np.cumsum(data.dt * rng.uniform(0.7, 1.3, n)),
    )
    found = audit(spoilt, channels_of("PendulumReal"))

    text = str(found)
    assert max(map(len, text.splitlines())) <= 80
    assert all(finding.sentence[:40] in text.replace("\n     ", " ") for finding in found.findings)
    plain = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert [f["kind"] for f in plain["findings"]] == [type(f).__name__ for f in found.findings]
    assert plain["channels"][2]["unit"] == "rad/s" and plain["findings"][0]["text"]


def test_every_kind_of_finding_is_a_sentence_with_a_remedy():
    for kind in Finding.__subclasses__():
        assert dataclasses.is_dataclass(kind) and kind.remedy.endswith(".")
        assert kind.sentence is not Finding.sentence


def test_names_must_be_one_per_channel(data):
    with pytest.raises(TrajectoryError, match="a name of its own for each of the 3 observation"):
        audit(data, ["q", "v"])
    with pytest.raises(TrajectoryError, match="a name of its own"):
        audit(data, ["q", "q", "v"])


@pytest.mark.parametrize("n", [5, 12, 20, 41, 60])
def test_short_recordings_are_no_error(n):
    time = 0.05 * np.arange(n)
    obs = np.stack([np.cos(time), np.sin(time), np.ones(n)], 1)
    data = Trajectories.from_arrays([obs], [np.sin(3.0 * time[:-1, None])], dt=0.05)

    assert audit(data).velocity_shift == {}


# --- channels that are not what they are taken for


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


@pytest.mark.parametrize("channels", [("angle", "speed"), KNOWN])
@pytest.mark.parametrize("noise", [0.0, 0.05])
@pytest.mark.parametrize(
    ("scales", "says"),
    [
        ((180.0 / np.pi, 1.0), "as if 'angle' were in degrees"),
        ((1.0, 180.0 / np.pi), "as if 'speed' were in degrees"),
        ((1000.0, 1.0), "as if 'angle' were in millimetres"),
        ((1.0, 30.0), "one of them is in other units."),
        ((1.0, 30.0 / np.pi), "as if 'speed' were in revolutions per minute"),
    ],
)
def test_a_position_in_other_units_than_its_velocity_is_refused(channels, noise, scales, says):
    data = changed(pendulum_data(noise=noise), lambda _, obs, actions: (obs * scales, actions))

    found = audit(data, channels)

    assert kinds(found) == {"OtherUnits"} and not found.usable
    assert found.findings[0].factor == pytest.approx(scales[0] / scales[1], rel=0.1)
    assert says in found.reason and "Give that one its unit in columns" in found.reason


def test_a_wrapped_angle_in_degrees_is_in_other_units_than_its_velocity():
    t = 0.01 * np.arange(401)
    obs = [
        np.stack([np.degrees(w * t + np.sin(w * t)) % 360.0, w + w * np.cos(w * t)], axis=1)
        for w in np.linspace(3.0, 6.0, 8)
    ]
    actions = [np.random.default_rng(0).standard_normal((400, 1))] * 8

    found = audit(Trajectories.from_arrays(obs, actions, dt=0.01), KNOWN)

    assert "as if 'angle' were in degrees" in found.reason


@pytest.mark.parametrize("factor", [0.2, 0.8, 1.25, 8.0])
@pytest.mark.parametrize("dt", [0.01, 0.05, 0.2])
def test_a_factor_that_a_scale_of_the_sensor_explains_is_left_to_it(factor, dt):
    data = changed(pendulum_data(dt), lambda _, obs, actions: (obs * [factor, 1.0], actions))

    assert "OtherUnits" not in kinds(audit(data, KNOWN)) | kinds(audit(data))


def swings(seed=0, n=8, steps=300, dt=0.02, noise=0.003):
    """Angles of a free pendulum with dry friction: w^2 = 42 1/s^2, up to 1.4 rad."""
    rng, recordings = np.random.default_rng(seed), []
    for q in rng.uniform(0.6, 1.4, n) * rng.choice([-1.0, 1.0], n):
        v, seen = 0.0, []
        for step in range(10 * steps + 1):
            if step % 10 == 0:
                seen.append(q)
            v += 0.1 * dt * (-42.0 * np.sin(q) - 0.86 * np.tanh(v / 0.01))
            q += 0.1 * dt * v
        recordings.append(np.array(seen)[:, None] + noise * rng.standard_normal((steps + 1, 1)))
    return recordings


def pendulum_twin(**changes):
    own = {"mass": 0.3, "com": 0.2, "inertia": 0.002, "observe": "q", "dt": 0.02}
    return twins.make("FreePendulum", **own | changes)


@pytest.mark.parametrize(
    "changes", [{}, {"com": 0.28}, {"com": 0.14}, {"mass": 0.6}, {"damping": 0.02}]
)
def test_an_angle_in_degrees_is_refused_if_the_twin_says_so_whatever_else_is_wrong(changes):
    twin, none = pendulum_twin(**changes), [np.zeros((300, 0))] * 8
    right = Trajectories.from_arrays(swings(), none, dt=0.02)
    degrees = Trajectories.from_arrays([np.rad2deg(q) for q in swings()], none, dt=0.02)

    found = audit(degrees, twin=twin)

    assert not found.usable and kinds(found) == {"MistakenUnits"}
    assert "{column: hinge_position, unit: deg}, or scale it by 0.0174533" in found.reason
    assert audit(right, twin=twin).usable and audit(degrees).usable


def test_an_angle_in_degrees_under_a_twin_that_is_all_wrong_is_a_caveat():
    none = [np.zeros((300, 0))] * 8
    degrees = Trajectories.from_arrays([np.rad2deg(q) for q in swings()], none, dt=0.02)

    found = audit(degrees, ["angle"], pendulum_twin(zero="up"))

    assert found.usable and kinds(found) == {"LikelyUnits"}
    assert "'angle' spans" in str(found) and "as if it were in degrees" in str(found.findings[0])


def test_the_line_to_write_names_the_column_of_the_log(tmp_path):
    rows = np.concatenate([np.rad2deg(q) for q in swings()])[:, 0]
    table = np.stack([np.tile(0.02 * np.arange(301), 8), np.repeat(np.arange(8), 301), rows], 1)
    np.savetxt(tmp_path / "log.csv", table, "%.9f", ",", header="t,run,enc", comments="")
    columns = {"time": "t", "episode": "run", "obs": ["enc"], "actions": []}

    found = audit(Trajectories.load(tmp_path / "log.csv", columns), twin=pendulum_twin())

    assert "'hinge_position' spans" in found.reason and "{column: enc, unit: deg}" in found.reason


@pytest.mark.parametrize(("unit", "factor"), [("millimetres", 1e3), ("centimetres", 1e2)])
def test_an_axis_in_millimetres_is_refused(unit, factor):
    rng = np.random.default_rng(0)
    force = 5.0 * np.sin(0.2 * rng.standard_normal((8, 200, 1)).cumsum(1))
    twin = twins.make("LinearAxis", mass=2.6)  # the real one has 2 kg
    clean = measured(twins.make("LinearAxis", mass=2.0), n_steps=200, commands=force)
    data = changed(clean, lambda _, obs, actions: (factor * obs, actions))

    found = audit(data, twin=twin)

    assert f"if it is in {unit}" in found.reason
    assert audit(clean, twin=twin).usable


@pytest.mark.parametrize("changes", [{}, {"mass": 1.0}, {"zero": "up"}, {"gravity": 0.0}])
def test_a_joint_that_turns_many_times_is_in_the_right_unit(changes):
    own = {"driven": True, "mass": 0.5, "com": 0.2, "inertia": 0.01}
    rng = np.random.default_rng(0)
    torque = 2.0 + np.sin(0.05 * rng.standard_normal((6, 300, 1)).cumsum(1))
    wheel = {"gravity": 0.0} if "gravity" in changes else {}
    real = twins.make("FreePendulum", damping=0.02, **own, **wheel)
    data = measured(real, n=6, n_steps=300, noise=np.array([1e-3, 2e-2]), commands=torque)

    found = audit(data, twin=twins.make("FreePendulum", **own | changes))

    assert np.ptp(data.obs[..., 0]) > 20.0 * np.pi
    assert not kinds(found) & {"MistakenUnits", "LikelyUnits", "OtherUnits"}


def test_a_twin_of_another_system_is_refused(data):
    with pytest.raises(TrajectoryError, match="CartPole has 5 channels and 1 commands; the data"):
        audit(data, twin=twins.make("CartPole"))


# --- backward differences


def differentiated(noise=1e-4, dt=0.01):
    """An angle of an encoder, and its backward difference."""
    rng, t = np.random.default_rng(0), dt * np.arange(1, 1001)
    obs = []
    for w in np.linspace(2.0, 5.0, 6):
        angle = np.sin(w * t) + noise * rng.standard_normal(1000)
        obs.append(np.stack([angle, np.diff(angle, prepend=0.0) / dt], 1)[1:])
    return Trajectories.from_arrays(obs, [rng.standard_normal((998, 1))] * 6, dt=dt)


@pytest.mark.parametrize("digits", [15, 4])
def test_a_backward_difference_is_recognised_and_offered_as_a_correction(digits):
    data = changed(differentiated(), lambda _, obs, u: (obs.round(digits), u))

    found = audit(data, KNOWN)
    better = found.corrected(data)

    assert kinds(found) == {"BackwardDifference"} and found.usable
    assert "'speed' is the backward difference of 'angle'" in str(found) and "5 ms" in str(found)
    assert found.velocity_shift == {"speed": 0.005}
    assert found.corrections == ("'speed' was shifted by -5 ms.",)
    central = np.gradient(better.obs[..., 0], 0.01, axis=1)[:, 1:-1]
    np.testing.assert_allclose(better.obs[:, 1:-1, 1], central, atol=0.02)


def test_a_speed_that_a_sensor_measures_half_a_sample_late_is_no_backward_difference():
    rng, t = np.random.default_rng(0), 0.01 * np.arange(1000)
    obs = np.stack([np.sin(3.0 * t), 3.0 * np.cos(3.0 * (t - 0.005))], 1)
    torque = [rng.standard_normal((999, 1))]

    for noise in ([0.0, 0.0], [1e-4, 3e-2]):
        seen = obs + noise * rng.standard_normal(obs.shape)
        assert kinds(audit(Trajectories.from_arrays([seen], torque, dt=0.01), KNOWN)) <= {
            "PoorExcitation"
        }


def test_a_twin_that_steps_like_a_backward_difference_raises_no_alarm():
    semi, exact = (twins.make(name) for name in ("CartPole", "LinearAxis"))
    force = np.sin(0.2 * np.random.default_rng(0).standard_normal((8, 200, 1)).cumsum(1))
    cart = measured(semi, n_steps=200)
    axis = measured(exact, n_steps=200, commands=force)
    differences = changed(
        axis,
        lambda _, obs, u: (
            np.stack([obs[1:, 0], np.diff(obs[:, 0]) / exact.dt], 1),
            u[1:],
        ),
    )

    assert audit(cart, twin=semi).findings == ()
    assert "BackwardDifference" in kinds(audit(differences, twin=exact))
    # Without noise and without a twin, nobody knows.
    assert "BackwardDifference" not in kinds(audit(differences))


def test_a_position_and_a_velocity_that_are_swapped_are_refused():
    data = changed(pendulum_data(), lambda _, obs, actions: (obs[:, ::-1], actions))

    found = audit(data, KNOWN)

    assert kinds(found) == {"Swapped"} and not found.usable
    assert "'angle' should be a position and is the derivative of 'speed'" in found.reason
    assert "in the order of the twin's channels" in found.reason


def test_units_that_nobody_says_are_not_swapped():
    data = changed(pendulum_data(), lambda _, obs, actions: (obs[:, ::-1], actions))

    assert audit(data, ["a", "b"]).findings == ()


# --- single samples


@pytest.mark.parametrize("channel", [0, 1])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_single_sample_that_jumps_away_and_back_is_refused_and_cut_out(channel, noise):
    clean = pendulum_data(noise=noise)

    def spoil(i, obs, actions):
        obs[100 + 10 * i, channel] += 3.0 * np.ptp(obs[:, channel])
        return obs, actions

    data = changed(clean, spoil)
    found = audit(data, KNOWN)
    better = found.corrected(data)

    [finding] = found.findings
    assert type(finding).__name__ == "Glitches" and not found.usable
    assert [(p.trajectory, p.first) for p in finding.places] == [
        (i, 100 + 10 * i) for i in range(8)
    ]
    assert f"'{KNOWN[channel].name}' jumps to" in found.reason and "cuts" in found.reason
    assert audit(better, KNOWN).findings == () and len(better) == 16
    assert found.corrections == ("Samples were cut out at 8 places with outliers.",)


@pytest.mark.parametrize("what", ["an impact", "a tick at rest", "a wrapped angle", "a blow"])
def test_a_jump_that_motion_makes_is_no_glitch(what):
    def shape(i, obs, actions):
        if what == "an impact":
            obs[200:, 1] *= -1.0
        if what == "a blow" and i == 3:
            obs[200:260, 1] += 100.0 * np.exp(-np.arange(60) / 2.0)
        if what == "a tick at rest":
            obs[:] = obs[0]
            obs[200, 0] += 1e-3
        if what == "a wrapped angle":
            obs[:, 0] = np.pi - 0.01 * np.abs(obs[:, 0])
            obs[200, 0] -= 2.0 * np.pi
        return obs, actions

    assert "Glitches" not in kinds(audit(changed(pendulum_data(), shape), KNOWN))
