"""Segments of uninterrupted rows as they were measured, the input of all checks."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int

from sb3_hds.core.trajectories import Trajectories
from sb3_hds.data.audit.finding import Place


class Segment(NamedTuple):
    """
    Consecutive rows without a gap.

    :param source: recording, for messages
    :param trajectory: number of the trajectory made from them
    :param numbers: of the rows in the recording, from 0
    :param times: since the first sample of the trajectory [s]
    :param obs: shape ``(rows, n_obs)``
    """

    source: str
    trajectory: int
    numbers: Int[np.ndarray, " rows"]
    times: Float64[np.ndarray, " rows"]
    obs: Float64[np.ndarray, "rows n_obs"]

    @property
    def dt(self) -> float:
        """Median interval [s]."""
        return float(np.median(np.diff(self.times)))

    def place(self, first: int, last: int) -> Place:
        """:return: the place of its rows ``first`` to ``last``"""
        return Place(
            self.source,
            int(self.numbers[first]),
            int(self.numbers[last]),
            self.trajectory,
            float(self.times[first]),
            float(self.times[max(first - 1, 0)]),
            float(self.times[min(last + 1, len(self.times) - 1)]),
        )


def segments_of(data: Trajectories) -> list[Segment]:
    """:return: for each trajectory, the rows of its log, or else its samples"""
    chosen = set(data.origin.tolist())
    parts = [part for part in data.report.parts if part.recording in chosen] if data.report else []
    samples = list(zip(data.origin.tolist(), data.lengths.tolist(), strict=True))
    # Trajectories that were cut or selected no longer match the recordings one to one.
    if parts and [(part.recording, part.n_steps) for part in parts] == samples:
        return [
            Segment(p.rows.source, i, p.rows.numbers, p.rows.times - p.begin, p.rows.obs)
            for i, p in enumerate(parts)
        ]
    numbers = [np.arange(n + 1) for n in data.lengths]
    return [
        Segment(f"trajectory {i}", i, k, data.dt * k, data.obs[i, : len(k)])
        for i, k in enumerate(numbers)
    ]


def all_samples(data: Trajectories) -> tuple[Place, ...]:
    """:return: one place for each trajectory, from its first sample to its last"""
    return tuple(Place(f"trajectory {i}", 0, int(n), i) for i, n in enumerate(data.lengths))


def joined(segments: Sequence[Segment]) -> Float64[np.ndarray, "rows n_obs"]:
    """:return: the rows of all segments"""
    return np.concatenate([segment.obs for segment in segments])


def steps_of(segments: Sequence[Segment]) -> Float64[np.ndarray, "steps n_obs"]:
    """:return: the differences of successive rows within all segments"""
    return np.concatenate([np.diff(segment.obs, axis=0) for segment in segments])
