"""Published data sets are read with small maps, and the audit says what is true of them."""

import functools
import os

import measured_rigs
import numpy as np
import pytest
from cases import each

from sb3_hds import audit
from sb3_hds.data.audit.velocity import best_pairs, velocity_pairs

pytestmark = [
    pytest.mark.measured,
    pytest.mark.skipif("SB3_HDS_DATA" not in os.environ, reason="data outside the repository"),
]

RIGS = {
    "emps": lambda: measured_rigs.emps("emps/DATA_EMPS*.mat").data,
    "multiarm": lambda: measured_rigs.multiarm().data,
    "dfki": lambda: measured_rigs.dfki("tau_con").data,
}


@functools.cache
def load(name):
    """Each data set, read once; those of servos as they were logged."""
    if name in RIGS:
        return RIGS[name]()
    return measured_rigs.load(f"{name}/*.json", measured_rigs.SERVO)


LATE = "UnevenSampling VelocityShift"
# Of the channels: from the data sets' own descriptions, and of numpy on the raw columns.
RANGES = {
    "emps": [(-2.2e-5, 0.2465073865)],
    "bam_xl330": [(-1.209, 1.241), (-13.65, 13.15)],
    "bam_sts3250": [(-1.731, 1.734), (-8.60, 8.60)],
    "multiarm": [(1.5231637, 4.7661103), (-11.5086622, 11.677117)],
    "dfki": [(-0.447, 0.361), (-1.815, 1.571), (-4.09, 4.13), (-12.9, 12.1)],
}


@each(
    # One slow profile, and one with pulses.
    ("emps", [24840] * 2, 0.001, "PoorExcitation"),
    ("bam_xl330", None, 0.0053, LATE),
    ("bam_sts3250", None, 0.0205, f"{LATE} PoorExcitation ConstantCommand"),
    ("multiarm", [9166] * 4, 0.001, ""),
    # A regular clock that took a few steps to start.
    ("dfki", [4998] * 2, 0.002, "JitteredStamps MissingRows"),
)
def test_a_published_data_set_is_read_and_judged(name, lengths, dt, findings):
    data = load(name)

    assert data.dt == dt and data.n_obs == len(RANGES[name])
    if lengths is None:  # six seconds each
        np.testing.assert_allclose(data.lengths * data.dt, 6.0, atol=0.02)
    else:
        assert data.lengths.tolist() == lengths
    for channel, (low, high) in enumerate(RANGES[name]):
        values = np.concatenate([data.episode(i)[0][:, channel] for i in range(len(data))])
        # Interpolation never leaves the range of the rows, and may cut the top of a noisy one.
        slack = 1e-6 + 0.05 * (high - low)
        assert low - 1e-6 <= values.min() <= low + slack
        assert high - slack <= values.max() <= high + 1e-6
    found = audit(data)
    assert {type(finding).__name__ for finding in found.findings} == set(findings.split())
    assert found.usable and data.report.altered == (name not in ("emps", "multiarm"))


@pytest.mark.parametrize("name", ["bam_xl330", "bam_sts3250"])
def test_servos_report_their_speed_some_20_ms_late_whatever_they_do(name):
    data = load(name)
    each = [audit(data[i]).velocity_shift.get("speed") for i in range(len(data))]
    late = [shift for shift in each if shift is not None]

    found = audit(data)

    assert found.velocity_shift["speed"] == pytest.approx(0.019, abs=0.003)
    # Recordings agree, whatever the gain, the motion and the rate at which they were logged.
    assert len(late) >= len(data) / 2
    np.testing.assert_allclose(late, found.velocity_shift["speed"], atol=0.008)
    assert audit(found.corrected(data)).velocity_shift == {}


def test_backward_differences_are_half_a_sample_late_and_no_finding():
    lags = best_pairs(velocity_pairs(load("dfki"), ["q1", "q2", "v1", "v2"]))
    assert [(lag.velocity, lag.position) for lag in lags] == [(2, "q1"), (3, "q2")]
    np.testing.assert_allclose([lag.samples for lag in lags], 0.5, atol=0.02)
