"""Velocities that were computed as backward differences of positions."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from sb3_hds.core.trajectories import Trajectories
from sb3_hds.core.twin import Twin
from sb3_hds.data.audit.finding import recordings
from sb3_hds.data.audit.replay import replayed, stretches_in
from sb3_hds.data.audit.stretches import all_samples
from sb3_hds.data.audit.velocity import Match, VelocityShift, difference_of


@dataclasses.dataclass(frozen=True)
class BackwardDifference(VelocityShift):
    """A velocity that is the backward difference of its position, and so half a sample late."""

    @property
    def sentence(self) -> str:
        return (
            f"'{self.channel}' is the backward difference of '{self.position}', which belongs half "
            f"a sample, {1e3 * self.seconds:.3g} ms, earlier ({recordings(self.places)})."
        )

    remedy = (
        "Shift it: audit.corrected(data). No sensor is late, unless the twin computes its velocity "
        "in the same way."
    )


def backward_differences(
    data: Trajectories, names: Sequence[str], matches: Sequence[Match], twin: Twin | None
) -> list[BackwardDifference]:
    """
    :param data: at one interval
    :param names: of the observation channels
    :param matches: of the data
    :param twin: if its own velocities are backward differences (semi-implicit Euler), they are not
        reported; without a twin, only differences that carry the noise of the position are
    """
    found: dict[int, tuple[Match, bool]] = {}
    for match in matches:
        difference = difference_of(match.pairs, data.dt)
        if match.agrees and difference.backward:
            found[match.velocity] = match, difference.rough
    own = _own(data, twin, [match for match, _ in found.values()]) if twin and found else None
    whole = all_samples(data)
    return [
        BackwardDifference(
            names[v],
            whole,
            position=match.position,
            samples=0.5,
            seconds=0.5 * data.dt,
            stderr=0.0,
        )
        for v, (match, rough) in found.items()
        if (rough if own is None else v not in own)
    ]


def _own(data: Trajectories, twin: Twin, matches: Sequence[Match]) -> set[int] | None:
    """Velocity channels that are backward differences in a simulation; None: it says nothing."""
    stretches = stretches_in(data)
    if stretches is None:
        return None
    obs = replayed(twin, stretches, np.ones(data.n_obs)).obs
    obs = obs[np.isfinite(obs).all((1, 2))]
    if not len(obs):
        return None
    own = set()
    for match in matches:
        first, *second = (obs[..., part] for part in match.parts)
        position = np.unwrap(np.arctan2(second[0], first), axis=1) if second else first
        pairs = list(zip(position, obs[..., match.velocity], strict=True))
        if difference_of(pairs, data.dt).backward:
            own.add(match.velocity)
    return own
