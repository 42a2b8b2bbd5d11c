"""The audit of measured data, which finds defects before any physics is fitted."""

import math
from collections.abc import Sequence

import numpy as np

from sb3_hds.core.declarations import Channel
from sb3_hds.core.trajectories import Trajectories
from sb3_hds.core.trajectories.episodes import same_interval
from sb3_hds.core.twin import Twin
from sb3_hds.data.audit.excitation import StandingStill, WithinNoise, excitation, stillness_of
from sb3_hds.data.audit.finding import Finding
from sb3_hds.data.audit.jumps import Outliers, glitches, outliers, reinitialised
from sb3_hds.data.audit.plateaus import reached_limits, repeated_samples, saturated, stuck
from sb3_hds.data.audit.results import Audit, ChannelSummary
from sb3_hds.data.audit.segments import joined, segments_of
from sb3_hds.data.audit.timing import timing
from sb3_hds.data.audit.units import mistaken_units, other_units, swapped
from sb3_hds.data.audit.velocity import backward_differences, velocity_pairs, velocity_shifts
from sb3_hds.data.resampling.report import Reading
from sb3_hds.data.resampling.values import resolutions
from sb3_hds.errors import TrajectoryError


def audit(
    data: Trajectories,
    channels: Sequence[str | Channel] | None = None,
    twin: Twin | None = None,
) -> Audit:
    """
    Find defects of the recording that a fit would otherwise attribute to physics.

    The audit looks for uneven, repeated and missing samples; stuck and saturated channels; joints
    at end stops that the twin lacks; resets of the state within a recording; outliers; velocities
    that are shifted in time or have other units than their positions; and insufficient excitation.
    It estimates the sensor noise at rest. Data read from logs are checked row by row, as measured.
    Velocity channels are identified by their correlation with the derivatives of other channels,
    and by their units if known; this also reveals swapped positions and velocities. Checks that
    rely on motion are skipped if there is none, or if there are outliers.

    :param data: measured or simulated
    :param channels: names of the observation channels, or a twin's ``channels``; default: those of
        the twin, those that were read, or ``obs[0]``, ``obs[1]``, ...
    :param twin: a model of the measured system, if available: it names the channels, and shows
        whether its own velocities are backward differences and which positions only fit in another
        unit
    :raises TrajectoryError: if the number of names is not that of the channels, or if the twin
        has other channels or commands, or a channel of another physical quantity
    """
    report = data.report if isinstance(data.report, Reading) else None
    if twin is not None:
        twin = _at_interval_of(twin, data)
        channels = twin.channels if channels is None else channels
    named = _channels(data, channels, report)
    columns = report.obs if report else [channel.name for channel in named]
    names = [channel.name for channel in named]
    actions = report.actions if report else [f"action[{j}]" for j in range(data.n_act)]
    rows = segments_of(data)
    # Resampling hides the quantisation, which the report still contains.
    resolution = (
        np.array(report.resolution) if report else resolutions([segment.obs for segment in rows])
    )
    still = stillness_of(rows, resolution)
    # Outliers inflate the standard deviations on which the other checks depend.
    found: list[Finding] = [*outliers(rows, names)]
    far = {finding.channel for finding in found}
    found += [f for f in glitches(rows, names, resolution) if f.channel not in far]
    if not found:
        found += excitation(data, still, names, actions)
    skip = any(isinstance(finding, Outliers | StandingStill | WithinNoise) for finding in found)
    found += timing(data, report)
    if not skip:
        pairs = velocity_pairs(data, names)
        found += [
            *(mistaken_units(data, twin, named, columns) if twin else ()),
            *(reached_limits(rows, twin) if twin else ()),
            *reinitialised(rows, names, resolution),
            *other_units(named, pairs),
            *swapped(named, pairs),
            *velocity_shifts(pairs),
            *backward_differences(data, pairs, twin),
            *stuck(rows, names, resolution),
            *saturated(rows, names, resolution),
            *repeated_samples(rows, names, resolution),
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


def _at_interval_of(twin: Twin, data: Trajectories) -> Twin:
    """
    The twin at the sampling interval of the data.

    :raises TrajectoryError: if the numbers of channels or commands differ
    """
    if (len(twin.channels), len(twin.actuators)) != (data.n_obs, data.n_act):
        raise TrajectoryError(
            f"{twin.name} has {len(twin.channels)} channels and {len(twin.actuators)} commands; "
            f"the data have {data.n_obs} and {data.n_act}. Choose matching columns, or another "
            "twin."
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
            f"channels must contain a unique name for each of the {data.n_obs} observation "
            f"channels, got {[channel.name for channel in named]}."
        )
    misfit = report.misfit(named) if report else ""
    if misfit:
        raise TrajectoryError(misfit)
    return named
