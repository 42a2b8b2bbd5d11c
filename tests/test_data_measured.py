"""Published data sets are read with small maps, and the audit says what is true of them."""

import os
import warnings
from pathlib import Path

import numpy as np
import pytest

from sb3_hds import Trajectories, audit
from sb3_hds.data import SamplingWarning

pytestmark = [
    pytest.mark.measured,
    pytest.mark.skipif("SB3_HDS_DATA" not in os.environ, reason="data outside the repository"),
]

MULTIARM = "multiarm_pendulum/SinglePendulumDataForParameterEstimation.mat"
SERVO = {
    "time": "timestamp",
    "obs": ["position", "speed"],
    "actions": ["goal_position", "torque_enable"],
}

MAPS = {
    # Electro-mechanical positioning system: amplifier voltage to force by the published gain.
    "emps": (
        "emps/DATA_EMPS*.mat",
        {
            "time": "t",
            "obs": ["qm"],
            "actions": [{"column": "vir", "scale": 35.150652}],
            "condition": {"from": "filename"},
        },
    ),
    # Servo bench: JSON with a list of entries; the gain is the same for all of a file.
    "bam_xl330": ("bam_xl330/*.json", SERVO | {"condition": {"column": "kp"}}),
    "bam_sts3250": ("bam_sts3250/*.json", SERVO | {"condition": {"column": "trajectory"}}),
    # Free swings: cells of a .mat file are episodes, and nothing is commanded.
    "multiarm": (
        MULTIARM,
        {"time": "Time_id", "obs": ["Y_id[0]", "Y_id[1]"], "actions": [{"constant": 0.0}]},
    ),
    "multiarm_validation": (
        MULTIARM,
        {"time": "Time_vad", "obs": ["Y_vad[0]", "Y_vad[1]"], "actions": []},
    ),
    "dfki": (
        "dfki_double_pendulum/*sys_id*.csv",
        {
            "time": "time",
            "obs": ["pos_meas1", "pos_meas2", "vel_meas1", "vel_meas2"],
            "actions": ["tau_con1", "tau_con2"],
        },
    ),
    "dfki_noise": (
        "dfki_double_pendulum/*noise_down*.csv",
        {"time": "time", "obs": ["pos1", "pos2", "vel1", "vel2"], "actions": ["tau1", "tau2"]},
    ),
}


NOISE = [(-1.9074e-4, 5.7222e-4), (5.7221e-4, 9.5369e-4), (-0.2143, 0.1924), (-0.1814, 0.1704)]


@pytest.fixture(scope="module")
def load():
    """Each data set, read once."""
    cache = {}

    def read(name):
        if name not in cache:
            files, columns = MAPS[name]
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", SamplingWarning)
                cache[name] = Trajectories.load(
                    str(Path(os.environ["SB3_HDS_DATA"], files)), columns=columns
                )
        return cache[name]

    return read


# Numbers of the data sets' own descriptions, and of numpy on the raw columns.
@pytest.mark.parametrize(
    ("name", "lengths", "dt", "ranges"),
    [
        ("emps", [24840] * 2, 0.001, [(-2.2e-5, 0.2465073865)]),
        ("bam_xl330", None, 0.0053, [(-1.209, 1.241), (-13.65, 13.15)]),
        ("bam_sts3250", None, 0.0205, [(-1.731, 1.734), (-8.60, 8.60)]),
        ("multiarm", [9166] * 4, 0.001, [(1.5231637, 4.7661103), (-11.5086622, 11.677117)]),
        ("multiarm_validation", [9166, 9165], 0.001, [(2.591, 3.688), (-4.388, 4.327)]),
        (
            "dfki",
            [4998] * 2,
            0.002,
            [(-0.447, 0.361), (-1.815, 1.571), (-4.09, 4.13), (-12.9, 12.1)],
        ),
        ("dfki_noise", [1422], 0.002, NOISE),
    ],
)
def test_a_published_data_set_is_read(load, name, lengths, dt, ranges):
    data = load(name)

    assert data.dt == dt and data.n_obs == len(ranges)
    assert lengths is None or data.lengths.tolist() == lengths
    for channel, (low, high) in enumerate(ranges):
        values = np.concatenate([data.episode(i)[0][:, channel] for i in range(len(data))])
        # Interpolation never leaves the range of the rows, and may cut the top of a noisy one.
        slack = 1e-6 + 0.05 * (high - low)
        assert low - 1e-6 <= values.min() <= low + slack
        assert high - slack <= values.max() <= high + 1e-6


def test_conditions_and_commands_are_those_of_the_files(load):
    assert sorted(set(load("bam_xl330").conditions)) == ["100", "200", "400", "800"]
    assert len(load("bam_xl330")) == 16 and len(load("bam_sts3250")) == 4
    assert load("emps").conditions == ("DATA_EMPS", "DATA_EMPS_PULSES")
    # 9.034307 V at most, 35.150652 N/V.
    assert load("emps").actions.max() == pytest.approx(9.034307344 * 35.150652, rel=1e-8)
    assert load("multiarm_validation").n_act == 0 and not load("multiarm").actions.any()


def test_six_seconds_of_the_servo_stay_six_seconds(load):
    for name in ("bam_xl330", "bam_sts3250"):
        data = load(name)
        np.testing.assert_allclose(data.lengths * data.dt, 6.0, atol=0.02)


def test_regular_data_sets_are_left_as_they_are(load):
    assert not load("emps").report.altered and not load("multiarm").report.altered


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        # One slow profile, and one with pulses.
        ("emps", {"PoorExcitation"}),
        ("bam_xl330", {"UnevenSampling", "VelocityShift"}),
        ("bam_sts3250", {"UnevenSampling", "VelocityShift", "PoorExcitation"}),
        ("multiarm", {"ConstantCommand"}),
        ("multiarm_validation", set()),
        # A regular clock that took a few steps to start.
        ("dfki", {"JitteredStamps", "MissingRows"}),
        ("dfki_noise", {"StandingStill", "JitteredStamps", "MissingRows"}),
    ],
)
def test_the_audit_of_a_published_data_set(load, name, expected):
    found = audit(load(name))

    assert {type(finding).__name__ for finding in found.findings} == expected
    assert found.usable == ("StandingStill" not in expected)
    assert max(map(len, str(found).splitlines())) <= 80


@pytest.mark.parametrize("name", ["bam_xl330", "bam_sts3250"])
def test_servos_report_their_speed_some_20_ms_late_whatever_they_do(load, name):
    data = load(name)
    each = [audit(data[i]).velocity_shift.get("speed") for i in range(len(data))]
    late = [shift for shift in each if shift is not None]

    found = audit(data)

    assert found.velocity_shift["speed"] == pytest.approx(0.019, abs=0.003)
    # Recordings agree, whatever the gain, the motion and the rate at which they were logged.
    assert len(late) >= len(data) / 2
    np.testing.assert_allclose(late, found.velocity_shift["speed"], atol=0.008)
    corrected = found.corrected(data)
    assert audit(corrected).velocity_shift == {}


def test_encoders_and_noise_are_recognised(load):
    servo, arm = audit(load("bam_xl330")), audit(load("dfki_noise"))

    # 4096 counts per turn.
    assert servo.channels[0].resolution == pytest.approx(2.0 * np.pi / 4096.0, rel=1e-6)
    assert arm.noise["vel1"] == pytest.approx(0.0589, rel=0.02)  # numpy's std of the column
    assert arm.stands_still == 1.0


def test_backward_differences_are_half_a_sample_late_and_no_finding(load):
    from sb3_hds.data.velocity import lags_of

    lags = lags_of(load("dfki"), ["q1", "q2", "v1", "v2"])

    assert [(lag.velocity, lag.position) for lag in lags] == [(2, "q1"), (3, "q2")]
    np.testing.assert_allclose([lag.samples for lag in lags], 0.5, atol=0.02)
