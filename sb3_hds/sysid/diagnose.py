"""Find out what a simulation gets wrong: propose on some recordings, confirm once on others."""

from collections.abc import Sequence
from typing import Literal

from sb3_hds.core import Effect, Trajectories, Twin
from sb3_hds.effects import ALL
from sb3_hds.errors import CalibrationError
from sb3_hds.sysid.calibrate import check_fits
from sb3_hds.sysid.diagnosis import Diagnosis
from sb3_hds.sysid.inquiry import EFFORTS, Inquiry


def diagnose(
    twin: Twin,
    data: Trajectories,
    *,
    effects: Sequence[type[Effect]] = ALL,
    calibrate: Sequence[str] = (),
    seed: int = 0,
    budget: Literal["full", "quick"] = "full",
    progress: bool = True,
) -> Diagnosis:
    """
    Name what a simulation gets wrong, if the data can.

    The data are audited first: what cannot support a verdict is refused with the reason, and other
    defects are caveats. Recordings are cut into windows, each simulated from a start state of its
    own. On one half of the recordings every candidate is fitted; the best is then confirmed on the
    other half, by at least 5 % less mean square error, a one-sided test on the logarithms of error
    ratios (one for each recording) or on scores, and an information criterion that counts
    correlated errors as fewer. What is not significantly worse than the best there stays as an
    alternative. After each cause that is accepted, everything is tested again. What remains is
    looked for in the force that is missing; a cause that leaves too much of it is not believed. In
    the end, causes are fitted to all recordings.

    :param twin: as it is believed
    :param data: measured, sampled at the twin's ``dt``
    :param effects: classes of the catalogue, or of your own
    :param calibrate: parameters of the twin that are not believed: they are refitted under every
        hypothesis, and are never a finding
    :param seed: of the split
    :param budget: ``"full"``, or ``"quick"``: fewer candidates are fitted to the end
    :param progress: whether a bar shows how far it is
    :return: verdict, findings, what was rejected, what cannot be told apart, the extended twin
    :raises CalibrationError: for other channels or another interval than the twin's, or an unknown
        name in ``calibrate``
    :raises TrajectoryError: if no recording is long enough
    """
    check_fits(twin, data)
    if budget not in EFFORTS:
        raise CalibrationError(f"budget must be 'full' or 'quick', got {budget!r}.")
    inquiry = Inquiry(twin, data, tuple(effects), tuple(calibrate), seed, budget, progress)
    reason = inquiry.poor()
    return inquiry.refused(reason) if reason else inquiry.run()
