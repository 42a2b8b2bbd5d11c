"""Data with defects taken out, as far as they can be."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from itertools import accumulate

import numpy as np

from sb3_hds.core.trajectories import Trajectories
from sb3_hds.errors import TrajectoryError

_ON_GRID = 0.02  # samples


def shifted(data: Trajectories, shifts: Mapping[int, float]) -> Trajectories:
    """
    Channels moved in time, interpolated linearly between samples.

    The samples at the ends of each episode for which a channel was not measured are left out.

    :param data: at one interval
    :param shifts: of observation channels: by how many samples each comes late; negative: early
    :raises TrajectoryError: if an episode is no longer than its shifts
    """
    before = max([0, *(math.ceil(-lag) for lag in shifts.values())])
    after = max([0, *(math.ceil(lag) for lag in shifts.values())])
    if data.lengths.min() <= before + after:
        shortest = int(data.lengths.argmin())
        raise TrajectoryError(
            f"Trajectory {shortest} has {data.lengths[shortest]} steps, too few for shifts that "
            f"leave out {before + after} of them. Leave it out: data[data.lengths > "
            f"{before + after}]."
        )
    obs, actions = [], []
    for i, n in enumerate(data.lengths):
        x, u = data.episode(i)
        rows, moved = np.arange(len(x)), x.copy()
        for channel, lag in shifts.items():
            moved[:, channel] = np.interp(rows + lag, rows, x[:, channel])
        obs.append(moved[before : len(x) - after])
        actions.append(u[before : n - after])
    return _rebuilt(data, obs, actions, range(len(data)))


def cut(data: Trajectories, places: Sequence[tuple[int, float, float]]) -> Trajectories:
    """
    Episodes cut where a new one begins inside them, or where samples have to go; pieces without a
    step are left out.

    :param data: at one interval
    :param places: trajectory, and the times of the last sample before and the first one after [s],
        since its beginning
    """
    obs, actions, sources = [], [], []
    for i, n in enumerate(data.lengths):
        x, u = data.episode(i)
        here = sorted((last, first) for trajectory, last, first in places if trajectory == i)
        ends = [math.floor(last / data.dt + _ON_GRID) + 1 for last, _ in here]
        begins = list(accumulate((math.ceil(first / data.dt - _ON_GRID) for _, first in here), max))
        for a, b in zip([0, *begins], [*ends, int(n) + 1], strict=True):
            if b - a > 1:  # the action before the cut led nowhere that was measured
                obs.append(x[a:b])
                actions.append(u[a : b - 1])
                sources.append(i)
    if not obs:
        raise TrajectoryError("No piece between the cuts has a step. Look at the recording itself.")
    return _rebuilt(data, obs, actions, sources)


def _rebuilt(
    data: Trajectories,
    obs: Sequence[np.ndarray],
    actions: Sequence[np.ndarray],
    sources: Sequence[int],
) -> Trajectories:
    """Trajectories with the labels of those that they are made of, and no rows behind them."""
    labels = [data.conditions[i] for i in sources]
    made = Trajectories.from_arrays(obs, actions, dt=data.dt, conditions=labels)
    report = data.report
    return dataclasses.replace(
        made,
        origin=data.origin[list(sources)],
        report=report and dataclasses.replace(report, parts=()),
    )
