"""The residual force beside the causes, and whether their sizes are constant."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_hds.sysid.comparison.halves import Accepted, Base
from sb3_hds.sysid.comparison.parameter_stability import Change, change
from sb3_hds.sysid.comparison.search import Search
from sb3_hds.sysid.comparison.unexplained import (
    PredictableForce,
    ResidualForce,
    ShortWindows,
    predictable_force,
    residual_forces,
    short_windows,
    weighed,
)
from sb3_hds.sysid.diagnosis.findings import NO_CONSTANT, nearest_in_words
from sb3_hds.sysid.diagnosis.preparation import IRRELEVANT, Prepared

# A cause that explains less than this share of what can be explained is not the cause.
LEAST_SHARE = 0.9
# The same of a cause and of how its size changes with time: a force whose form is a little wrong
# seems to change with position or speed, but not with time.
_LEAST_SHARE_IN_TIME = 0.95
# A force that moves a short window by a smaller share of what is irrelevant does not matter.
_OF_IRRELEVANT = 0.18


class Left(NamedTuple):
    """
    What a model leaves unexplained.

    :param predictable: the part that can be predicted
    :param predicted: mean square of that part, in units of the force's standard error under the
        noise of the search
    :param power: mean square of the whole residual force, likewise
    :param residual: all of it
    :param short: the short windows in which it was estimated
    """

    predictable: PredictableForce | None
    predicted: float
    power: float
    residual: ResidualForce
    short: ShortWindows


class Residuals:
    """
    :param given: recordings
    :param search: candidates on two halves of the evidence
    :param seed: of the split
    """

    def __init__(self, given: Prepared, search: Search, seed: int) -> None:
        self.given, self.search, self.seed = given, search, seed
        self.hypotheses = search.hypotheses
        #: why causes were turned down, by key
        self.rejected_for: dict[str, str] = {}

    def left(self, base: Base) -> Left:
        """:return: what the current model leaves"""
        short = self._short(base.point.theta)
        residual = residual_forces(short, self.given.data)
        power = float(np.mean(np.sum(weighed(residual) ** 2, 1)))
        mind = float(np.mean((IRRELEVANT * self.given.std / residual.noise) ** 2))
        least = _OF_IRRELEVANT**2 * mind * residual.numbers
        found = predictable_force(
            residual, self.given.data, self.hypotheses.twin.joints, self.seed, least
        )
        # Errors of forces are known better the less is missing: two twins need one unit.
        unit = float(np.mean((residual.noise / self.search.noise) ** 2))
        predicted = 0.0 if found is None else unit * found.power
        return Left(found, predicted, unit * power, residual, short)

    def constant(self, found: list[Accepted], base: Base) -> tuple[list[Accepted], Base, Left, str]:
        """
        A cause whose size is not constant is only the nearest name. Effects with memory are not
        tested, since short windows are insensitive to them.

        :return: the causes before the first one that varies, the model and the residuals with
            them, and a sentence on that one
        """
        left = self.left(base)
        for n, one in enumerate(found):
            if (changes := self._varies(one, base, left)) is None:
                continue
            key = one.tried.candidate.key
            self.rejected_for[key] = NO_CONSTANT
            for later in found[n:]:
                base = self.search.without(base, later.tried.candidate)
            return found[:n], base, self.left(base), nearest_in_words(key, changes)
        return found, base, left, ""

    def left_by(self, found: Sequence[Accepted], base: Base) -> Left | None:
        """
        :return: the residuals beside these causes; None if the size of one of them is not constant
        """
        left = self.left(base)
        return None if any(self._varies(one, base, left) for one in found) else left

    def explained(
        self,
        found: Sequence[Accepted],
        start: Base,
        base: Base,
        before: Left,
        left: Left,
    ) -> float:
        """
        Share of the predictable residual force that is explained; for a cause with memory, of the
        error of whole windows if that is more, since short windows are insensitive to memory.
        """
        share = _share(before, left)
        if any(self.hypotheses.remembers(one.tried.candidate) for one in found):
            half, noise = self.search.confirm, left.residual.noise / self.search.noise
            floor = float(np.mean(noise**2)) * half.evidence.shots.n
            wrong, rest = (half.total(point) - floor for point in (start.held_out, base.held_out))
            share = max(share, 1.0 - rest / wrong if 0.0 < rest < wrong else float(rest <= 0.0))
        return share

    def _varies(self, one: Accepted, base: Base, left: Left) -> Change | None:
        """:return: how the size of a cause changes, if to follow that would explain much"""
        candidate = one.tried.candidate
        if self.hypotheses.remembers(candidate):
            return None
        own = self.hypotheses.indices(candidate)
        changes = change(left.short, left.residual, own, base.free)
        if changes is None:
            return None
        gone = max(self._gone(one, base, left), 0.0)
        least = _LEAST_SHARE_IN_TIME if changes.goes_with == "time" else LEAST_SHARE
        return changes if gone < least * (gone + changes.gain) else None

    def _gone(self, one: Accepted, base: Base, left: Left) -> float:
        """:return: by which a cause lowers the cost of short windows"""
        theta = self.search.without(base, one.tried.candidate).point.theta
        without = self._short(theta)
        return without.point.cost - left.short.point.cost

    def _short(self, theta: np.ndarray) -> ShortWindows:
        half = self.search.select
        return short_windows(
            half.evidence, theta, self.given.data, self.given.period, 2 * self.given.most_windows
        )


def _share(before: Left, left: Left) -> float:
    """:return: of the residual force that can be predicted, how much is explained"""
    gone = max(before.power - left.power, 0.0)
    return gone / (gone + left.predicted) if gone + left.predicted else 1.0
