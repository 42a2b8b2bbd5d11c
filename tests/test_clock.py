"""The clock behind time stamps is found, and no row moves farther than its stamp is off."""

import re

import numpy as np
import pytest
from cases import each

from sb3_hds import Trajectories
from sb3_hds.data.columns import columns_from
from sb3_hds.data.resampling.resample import resample
from sb3_hds.data.resampling.rows import Rows
from sb3_hds.errors import TrajectoryError

COLUMNS = {"time": "t", "obs": ["q"], "actions": ["u"]}
FLOAT32_EPOCH = np.float32(1.76e9 + 0.01 * np.arange(3000)).astype(float)


def motion(t):
    return np.sin(7.0 * t)


def read(*stamps, values=None, **more):
    """:return: observations and actions of each episode, and the report; actions count the rows"""
    episodes = []
    for i, t in enumerate(stamps):
        q = motion(t) if values is None else values[i]
        k = np.arange(len(t))
        episodes.append(Rows(f"log {i}", k, np.asarray(t, float), q[:, None], 1.0 * k[:, None], ""))
    data = resample(episodes, columns_from(COLUMNS | more))
    obs, actions = zip(*(data.episode(i) for i in range(len(data))), strict=True)
    return [x[:, 0] for x in obs], [u[:, 0] for u in actions], data.report


def regular(hz=100.0, n=3000):
    return np.arange(n) / hz


@pytest.mark.filterwarnings("error::sb3_hds.data.SamplingWarning")
@pytest.mark.parametrize("logger", ["regular", "late", "rounded"])
def test_rows_of_a_regular_clock_stay_as_they_are(logger, tmp_path):
    hz = 150
    t = regular(hz)
    stamps = np.round(t, 3) if logger == "rounded" else t.copy()
    stamps[0] += 0.85 / hz * (logger == "late")
    table = np.stack([stamps, motion(t), 0.0 * t], 1)
    np.savetxt(tmp_path / "log.csv", table, "%.9f", ",", header="t,q,u", comments="")

    data = Trajectories.load(tmp_path / "log.csv", columns=COLUMNS)

    assert data.dt == pytest.approx(1.0 / hz, rel=1e-9)
    np.testing.assert_array_equal(data.obs[0, :, 0], np.round(motion(t), 9))
    assert data.report.recordings[0].clock == logger and not data.report.altered


@each((1000.0, 0.015625), (240.0, 0.01), (333.3, 0.001))
def test_ticks_of_the_logger_may_be_longer_than_the_interval(hz, tick):
    t = regular(hz, 6000)

    [obs], _, report = read(np.floor(t / tick) * tick, values=[motion(t)])

    assert report.dt == pytest.approx(1.0 / hz, rel=2e-4)
    np.testing.assert_array_equal(obs, motion(t))
    assert "stamps rounded to" in str(report) and report.recordings[0].repeated == ()


@pytest.mark.parametrize("digits", [9, 3])
def test_dropped_rows_are_filled_in_and_the_others_stay(digits):
    t = regular(150.0)
    gone = np.isin(np.arange(3000), [1000, 1001, 2000])

    [obs], [actions], report = read(np.round(t[~gone], digits), values=[motion(t[~gone])])

    assert report.dt == pytest.approx(1.0 / 150.0, rel=1e-9)
    assert report.recordings[0].missing == ((1000, 2), (1998, 1))
    np.testing.assert_array_equal(obs[~gone], motion(t[~gone]))
    np.testing.assert_allclose(obs[gone], motion(t[gone]), atol=1e-3)
    # A command is held until the next row.
    np.testing.assert_array_equal(actions[998:1004], [998, 999, 999, 999, 1000, 1001])
    assert "3 missing rows were filled in" in report.summary() and "gaps" not in report.summary()


def test_rows_written_twice_are_left_out_and_rows_that_share_a_tick_are_not():
    t = regular()
    twice = np.sort(np.concatenate([t, t[[10, 500, 2999]]]))

    [obs], _, report = read(twice)
    [every], _, doubled = read(np.repeat(t, 2))

    np.testing.assert_array_equal(obs, motion(t))
    np.testing.assert_array_equal(every, motion(t))
    assert report.recordings[0].repeated == (11, 502, 3002) and report.dt == doubled.dt == 0.01


@pytest.mark.parametrize("jitter", ["white", "delays", "bursts"])
def test_stamps_that_jitter_around_a_regular_sampler_move_no_row(jitter):
    rng, t = np.random.default_rng(0), regular()
    late = {
        "white": rng.normal(0.0, 0.002, 3000),
        "delays": rng.exponential(0.004, 3000),
        "bursts": 0.0099 * (7 - np.arange(3000) % 8),
    }[jitter]

    [obs], _, report = read(np.sort(t + late), values=[motion(t)])

    assert report.dt == pytest.approx(0.01, rel=1e-9) and not report.altered
    np.testing.assert_array_equal(obs, motion(t))
    assert report.recordings[0].clock == "jittered" and "rows are kept" in report.clocks()


def test_one_row_that_was_measured_late_is_interpolated_alone():
    t = regular()
    stamps = t.copy()
    stamps[1500] += 0.006

    [obs], _, report = read(stamps)

    others = np.arange(3000) != 1500
    np.testing.assert_allclose(obs[others], motion(t[others]), atol=1e-12)
    # Linear interpolation between 10 ms before and 6 ms after.
    assert obs[1500] == pytest.approx(motion(t[1500]), abs=49.0 * 0.01 * 0.006 / 2.0)
    assert report.recordings[0].late == (1500,)


@pytest.mark.parametrize("spread", [0.01, 0.17])
def test_intervals_that_vary_by_themselves_are_no_regular_clock(spread):
    """A loop that sleeps for a while after each step: what one step is late, all later ones are."""
    rng = np.random.default_rng(0)
    stamps = np.cumsum(0.01 * (1.0 + spread * rng.uniform(-1.7, 1.7, 3000)))

    [obs], _, report = read(stamps)

    assert report.recordings[0].clock == "irregular" and report.dt == 0.01
    begin = report.parts[0].begin
    np.testing.assert_allclose(obs, motion(begin + 0.01 * np.arange(len(obs))), atol=2e-3)
    assert "no regular clock" in report.clocks()


def test_a_clock_that_drifts_slowly_is_distinguished_from_jitter():
    """Two crystals: in a minute, the rate changes by 500 ppm; rows end up 1.5 off a line."""
    t = regular(n=6000)
    slow, fast = ((1.0 + 0.5 * change * t / t[-1]) * t for change in (5e-4, 2e-2))

    [obs], _, report = read(slow, values=[motion(t)])
    _, _, changed = read(fast)

    [sampling] = report.recordings
    np.testing.assert_array_equal(obs, motion(t))
    assert report.dt == pytest.approx(0.01, rel=5e-4) and sampling.clock == "regular"
    assert sampling.drift == pytest.approx(5e-4, rel=0.3) and "rate changes by" in str(report)
    assert changed.recordings[0].clock == "irregular" and changed.altered


def test_recordings_of_slightly_different_rates_have_one_interval():
    rates = (99.96, 100.0, 100.03)
    stamps = [regular(hz) for hz in rates]

    obs, _, report = read(*stamps)
    _, _, apart = read(regular(100.0), regular(100.0), regular(97.0))

    assert report.dt == 0.01 and not report.altered
    for values, t in zip(obs, stamps, strict=True):
        np.testing.assert_array_equal(values, motion(t))
    assert "Rates are 99.96 to 100.03 Hz" in str(report).replace("\n  ", " ")
    assert [r.resampled for r in apart.recordings] == [False, False, True] and apart.dt == 0.01


@pytest.mark.parametrize(("hz", "dt"), [(29.97, 1 / 29.97), (99.999, 0.01), (188.68, 0.0053)])
def test_an_interval_is_round_only_where_the_stamps_cannot_tell(hz, dt):
    assert read(regular(hz))[2].dt == pytest.approx(dt, rel=1e-9)


def test_an_interval_that_is_said_leaves_rows_that_agree_with_it():
    t = regular(30)
    [obs], _, report = read(np.round(t, 3), values=[motion(t)], dt=0.03333)
    np.testing.assert_array_equal(obs, motion(t))
    assert report.dt == 0.03333 and not report.altered


def test_rows_that_were_held_up_and_catch_up_are_no_gap():
    t = regular(n=1000)
    stamps = t.copy()
    stamps[400:420] = t[420] - 1e-4 * np.arange(20)[::-1] - 1e-4

    [obs], _, report = read(stamps, values=[motion(t)])

    np.testing.assert_array_equal(obs, motion(t))
    assert report.recordings[0].gaps == () and report.recordings[0].clock == "late"


@each(
    (FLOAT32_EPOCH, r"single precision \(float32\), numbers around 1.76e\+09 are 128 apart"),
    (np.floor(regular(n=500)), "500 rows share 5 of them"),
)
def test_stamps_that_tell_no_interval_are_refused_with_the_way_out(stamps, says):
    with pytest.raises(TrajectoryError, match=says) as refusal:
        read(stamps, values=[motion(regular(n=len(stamps)))])
    assert "remove 'time' from columns and give the interval: dt: SECONDS" in str(refusal.value)


@pytest.mark.parametrize("n", [3, 4, 8, 20])
def test_short_logs_have_a_clock_too(n):
    t = regular(n=n)

    for stamps in (t, np.round(t, 2), 1.7e9 + t):
        [obs], _, report = read(stamps, values=[motion(t)])
        np.testing.assert_array_equal(obs, motion(t))
        assert report.dt == pytest.approx(0.01, rel=1e-3)


def test_a_wrapped_angle_is_refused_only_where_it_is_interpolated_at_its_seam():
    t = regular(n=600)
    angle = (5.0 * t + np.pi) % (2.0 * np.pi) - np.pi
    seam = int(np.flatnonzero(np.diff(angle) < -3.0)[0])
    there, elsewhere = (np.delete(np.arange(600), gone) for gone in (seam, seam + 40))

    with pytest.raises(TrajectoryError, match="jumps by a full turn"):
        read(t[there], values=[angle[there]])
    assert len(read(t[elsewhere], values=[angle[elsewhere]])[0][0]) == 600
    for rows in (there, elsewhere):
        [obs], _, _ = read(t[rows], values=[angle[rows]], obs=[{"column": "q", "angle": True}])
        assert np.abs(obs - angle).max() < 1e-9
    with pytest.raises(TrajectoryError, match=r"jumps by a full turn after row .*angle: true"):
        read(t, values=[angle], dt=0.004)
    [obs], _, _ = read(t, values=[angle], dt=0.004, obs=[{"column": "q", "angle": True}])
    np.testing.assert_allclose(np.unwrap(obs), 0.02 * np.arange(len(obs)), atol=1e-9)


def test_of_many_channels_the_one_that_interpolation_changes_most_is_named():
    """White noise, relative to its standard deviation; of a few channels, all are named."""
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.008, 0.012, 500))
    smooth = motion(t)[:, None] * [1.0, 2.0, 50.0, 3.0]
    obs = np.column_stack([smooth, rng.normal(size=len(t))])
    names = ["a", "b", "c", "d", "noise"]

    def summary(n):
        rows = Rows("log", np.arange(len(t)), t, obs[:, n:], np.zeros((len(t), 1)), "")
        return resample([rows], columns_from(COLUMNS | {"obs": names[n:]})).report.summary()

    # Linear interpolation averages neighbours, and so loses a large part of white noise.
    share, worst = re.search(r"at most (\S+) % of a channel.* \((\w+) ", summary(0)).groups()
    assert worst == "noise" and 20.0 < float(share) < 100.0
    assert re.search("b [^ ]+, c [^ ]+, d [^ ]+, noise ", summary(1))
