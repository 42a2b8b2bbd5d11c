"""
Recordings beside a twin: whether they fit it, and it can be identified from them, how much each
channel varies, and its noise.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from sb3_hds.core import Trajectories, Twin
from sb3_hds.core.trajectories.episodes import same_interval
from sb3_hds.data.resampling.report import Reading
from sb3_hds.errors import CalibrationError

# From this ratio of two intervals on, one is taken to be in another unit.
_OTHER_UNIT = 100.0
# Of white noise of one, the standard deviation of fourth differences: the root of the sum of the
# squared binomial coefficients, 1 + 16 + 36 + 16 + 1. A smooth signal has hardly any.
_FOURTH = np.sqrt(70.0)
#: standard deviation of normal noise, in units of its median absolute value: the reciprocal of the
#: third quartile of the normal distribution
NORMAL = 1.4826
#: with fewer recordings, about so many stretches of them are the clusters of correlated errors
FEWEST_CLUSTERS, N_STRETCHES = 8, 16
# Rows of a recording from which fourth differences are taken.
_FEWEST_ROWS = 6


def white_noise(recordings: Sequence[Float[np.ndarray, "rows *k"]]) -> Float[np.ndarray, "*k"]:
    """
    :return: standard deviation of white noise on a smooth signal, from its fourth differences; more
        than that where the signal is not smooth from sample to sample
    """
    fourth = [np.diff(x, 4, axis=0) for x in recordings if len(x) >= _FEWEST_ROWS]
    if not fourth:
        return np.zeros(recordings[0].shape[1:])
    return np.asarray(NORMAL * np.median(np.abs(np.concatenate(fourth)), axis=0) / _FOURTH)


def channel_deviations(data: Trajectories) -> Float[np.ndarray, " obs"]:
    """:return: standard deviation of each channel over the data, one where it never changes"""
    real = np.concatenate([data.episode(i)[0] for i in range(len(data))])
    deviations = real.std(0)
    return np.where(deviations > 0.0, deviations, 1.0)


def check_fits(twin: Twin, data: Trajectories) -> None:
    """:raises CalibrationError: if the data cannot have been measured on what the twin simulates"""
    if (data.n_obs, data.n_act) != (len(twin.channels), len(twin.actuators)):
        names = ", ".join(channel.name for channel in twin.channels)
        raise CalibrationError(
            f"{twin.name} observes {len(twin.channels)} channels ({names}) and takes "
            f"{len(twin.actuators)} commands; the data have {data.n_obs} and {data.n_act}. "
            "Choose the columns, or the twin, that fit."
        )
    report = data.report if isinstance(data.report, Reading) else None
    misfit = report.misfit(twin.channels, twin.actuators) if report else ""
    if misfit:
        raise CalibrationError(misfit)
    if not same_interval(data.dt, twin.dt):
        unit = ""
        if data.dt / twin.dt >= _OTHER_UNIT:
            order = int(np.clip(round(np.log10(data.dt / twin.dt) / 3.0), 1, 3))
            unit = (
                f"The column of time may be in {('milli', 'micro', 'nano')[order - 1]}seconds: "
                "then say so in the map of columns, "
                f"time: {{column: NAME, scale: {10.0 ** (-3 * order):g}}}. Otherwise: "
            )
        raise CalibrationError(
            f"{twin.name} steps by {twin.dt:g} s and the data are sampled every {data.dt:g} s. "
            f"{unit}Use data.resample(dt={twin.dt:g}) (in the map of "
            f"columns, dt: {twin.dt:g}), or make the twin with dt={data.dt:g} (on the command "
            f"line, --set dt:{data.dt:g})."
        )


def refuse_slow(twin: Twin, what: str) -> None:
    """
    :param what: the name of the function that was called
    :raises CalibrationError: for a twin whose derivatives are finite differences
    """
    if twin.differentiability != "differences":
        return
    n_columns = 2 * len(twin.joints) + len(twin.parameters)
    raise CalibrationError(
        f"{what} does not take {twin.name}, whose derivatives are finite differences, as those of "
        "MuJoCo's engine: it linearises every window of the data for every candidate, here by "
        f"{n_columns} of them in each step, which takes hours. If nothing is in contact in the "
        "data, pass twins.from_mujoco(model, ignore=['contacts', 'limits'])."
    )
