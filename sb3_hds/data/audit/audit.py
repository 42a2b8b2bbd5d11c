"""Are these data fit for a verdict? Asked before any physics."""

import math
from collections.abc import Sequence

import numpy as np

from sb3_hds.core.signals import Channel
from sb3_hds.core.trajectories import Trajectories
from sb3_hds.core.trajectories.episodes import same_interval
from sb3_hds.core.twin import Twin
from sb3_hds.data.audit import continuity
from sb3_hds.data.audit.differences import backward_differences
from sb3_hds.data.audit.excitation import StandingStill, WithinNoise, excitation, stillness_of
from sb3_hds.data.audit.finding import Finding
from sb3_hds.data.audit.limits import reached_limits
from sb3_hds.data.audit.outliers import Outliers, glitches, outliers
from sb3_hds.data.audit.results import Audit, ChannelSummary
from sb3_hds.data.audit.stretches import Stretch, joined, stretches_of
from sb3_hds.data.audit.timing import (
    timing,
)
from sb3_hds.data.audit.units import mistaken_units, other_units, swapped
from sb3_hds.data.audit.velocity import matches_of, velocity_shifts
from sb3_hds.data.resampling.report import Reading
from sb3_hds.data.resampling.resolution import resolutions
from sb3_hds.errors import TrajectoryError


def audit(
    data: Trajectories,
    channels: Sequence[str | Channel] | None = None,
    twin: Twin | None = None,
) -> Audit:
    """
    Look for defects of the recording, which physics would have to explain otherwise.

    Uneven, repeated and missing samples; channels that are stuck or cut off; joints at stops that
    the twin does not have; a state that was put back inside a recording; values beyond all measure;
    a velocity that comes late or early, or in other units than its position; the noise while
    standing still; too little motion. Where the data were read from logs, rows are checked as they
    were measured. Velocities are found by their correlation with the derivatives of others, none in
    data that hardly move; where channels have units, these say which may be one, and positions and
    velocities that are swapped are found. What is judged by its motion is not judged in data
    without any, nor beside values beyond all measure.

    :param data: of any kind
    :param channels: names of the observation channels, or a twin's ``channels``; default: those of
        the twin, those that were read, or ``obs[0]``, ``obs[1]``, ...
    :param twin: of what was measured, as far as it is known: says what the channels are, whether
        its own velocities are backward differences, and which positions it cannot follow unless
        they are in another unit
    :raises TrajectoryError: if the number of names is not that of the channels, or if the twin has
        other channels or commands, or if one was read in a unit of something else
    """
    report = data.report if isinstance(data.report, Reading) else None
    if twin is not None:
        twin = _fitting(twin, data)
        channels = twin.channels if channels is None else channels
    named = _channels(data, channels, report)
    columns = report.obs if report else [channel.name for channel in named]
    names = [channel.name for channel in named]
    actions = report.actions if report else [f"action[{j}]" for j in range(data.n_act)]
    rows = stretches_of(data)
    # Interpolation has blurred the steps of what was resampled: the report remembers them.
    known = report and np.array(report.resolution)
    resolution = resolutions([stretch.obs for stretch in rows]) if known is None else known
    still = stillness_of(rows, resolution)
    # Where values are beyond all measure, so are the spreads that everything else is compared with.
    found: list[Finding] = _beyond(rows, names, resolution)
    if not found:
        found += excitation(data, still, names, actions)
    unfit = any(isinstance(finding, Outliers | StandingStill | WithinNoise) for finding in found)
    found += timing(data, report)
    if not unfit:
        matches = matches_of(data, names)
        found += [
            *(mistaken_units(data, twin, named, columns) if twin else ()),
            *(reached_limits(rows, twin) if twin else ()),
            *continuity.reinitialised(rows, names, resolution),
            *other_units(data, named, matches),
            *swapped(data, named, matches),
            *velocity_shifts(data, names, matches),
            *backward_differences(data, names, matches, twin),
            *continuity.stuck(rows, names, resolution),
            *continuity.saturated(rows, names, resolution),
            *continuity.repeated_samples(rows, names, resolution),
        ]
    values = joined(rows)
    summaries = tuple(
        ChannelSummary(
            channel.name,
            channel.unit,
            float(values[:, j].min()),
            float(values[:, j].max()),
            float(still.noise[j]) if np.isfinite(still.noise[j]) else None,
            float(resolution[j]),
        )
        for j, channel in enumerate(named)
    )
    return Audit(
        tuple(sorted(found, key=lambda finding: not finding.blocks)),
        summaries,
        still.share,
        data.conditions,
        tuple(data.lengths.tolist()),
        data.dt,
        report is not None,
    )


def _fitting(twin: Twin, data: Trajectories) -> Twin:
    """The twin at the interval of the data, if it is one of their system."""
    if (len(twin.channels), len(twin.actuators)) != (data.n_obs, data.n_act):
        raise TrajectoryError(
            f"{twin.name} has {len(twin.channels)} channels and {len(twin.actuators)} commands; "
            f"the data have {data.n_obs} and {data.n_act}. Choose the columns, or the twin, that "
            "fit."
        )
    if same_interval(twin.dt, data.dt):
        return twin
    return twin.at_interval(data.dt, math.ceil(data.dt * twin.substeps / twin.dt - 1e-9))


def _channels(
    data: Trajectories, channels: Sequence[str | Channel] | None, report: Reading | None
) -> list[Channel]:
    if channels is None and report is not None and any(report.units):
        channels = [Channel(*pair) for pair in zip(report.obs, report.units, strict=True)]
    elif channels is None:
        channels = report.obs if report else [f"obs[{j}]" for j in range(data.n_obs)]
    named = [Channel(c, "") if isinstance(c, str) else c for c in channels]
    if len(named) != data.n_obs or len({channel.name for channel in named}) < len(named):
        raise TrajectoryError(
            f"channels must hold a name of its own for each of the {data.n_obs} observation "
            f"channels, got {[channel.name for channel in named]}."
        )
    misfit = report.misfit(named) if report else ""
    if misfit:
        raise TrajectoryError(misfit)
    return named


def _beyond(rows: Sequence[Stretch], names: Sequence[str], resolution: np.ndarray) -> list[Finding]:
    """Outliers, and glitches of channels without any."""
    found: list[Finding] = [*outliers(rows, names)]
    far = {finding.channel for finding in found}
    return [*found, *(f for f in glitches(rows, names, resolution) if f.channel not in far)]
