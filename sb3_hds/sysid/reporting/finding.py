"""Parts of a diagnosis: findings, rejected candidates, and errors by horizon."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from sb3_hds.sysid.estimation.results import Estimate


@dataclasses.dataclass(frozen=True)
class Finding:
    """
    One cause.

    :param effect: name in the catalogue, or ``"parameter.NAME"``
    :param where: ``slot``, ``index`` and ``name`` of its place
    :param parameters: estimates with intervals and units, by short name
    :param alternatives: keys of candidates that the data cannot distinguish from it, by name and
        place
    :param p_value: of the test on held-out recordings that confirmed it; where several candidates
        were tested, its level was stricter
    :param family_p_value: of the gain of the best of all candidates, on the recordings that
        proposed it
    :param gain: share by which it lowers the mean square error of held-out recordings
    :param explanation: one sentence
    :param share: of the force at its joint that it carries, root mean squares; None where that was
        not computed
    """

    effect: str
    where: Mapping[str, Any]
    parameters: Mapping[str, Estimate]
    alternatives: tuple[str, ...]
    p_value: float
    family_p_value: float
    gain: float
    explanation: str
    share: float | None = None

    @property
    def key(self) -> str:
        """Name and place, as in ``rejected`` and ``detectable``."""
        own = self.where["slot"] == "parameter"
        return self.effect if own else f"{self.effect}.{self.where['name']}"


@dataclasses.dataclass(frozen=True)
class Rejected:
    """
    A candidate that was not accepted.

    :param name: effect and place
    :param gain: share by which it lowers the mean square error of held-out recordings, after what
        was accepted
    :param p_value: of that gain
    :param why: in words
    """

    name: str
    gain: float
    p_value: float
    why: str


@dataclasses.dataclass(frozen=True)
class HorizonGain:
    """
    Error of predictions a number of steps ahead, on held-out recordings, over all channels, in
    units of their noise.

    :param steps: ahead
    :param before: root mean square error of the nominal model, nuisances refitted
    :param after: of the extended one
    :param low: lower end of the 90 % interval of the relative gain
    :param high: upper end
    """

    steps: int
    before: float
    after: float
    low: float
    high: float
