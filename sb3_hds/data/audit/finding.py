"""The findings of an audit: a sentence with the channel, the samples and the remedy."""

import abc
import dataclasses
from typing import Any, ClassVar, NamedTuple

from sb3_hds.data.wording import counted

_SHOWN = 2  # places or recordings that a sentence names


class Place(NamedTuple):
    """
    Consecutive samples of one recording.

    :param source: trajectory, or file
    :param first: first sample, or row of the file, from 0
    :param last: last sample, or row of the file
    :param trajectory: its number in the data
    :param time: of the first sample, since the beginning of the trajectory [s]
    :param before: time of the sample before the first one [s]
    :param after: time of the sample after the last one [s]
    """

    source: str
    first: int
    last: int
    trajectory: int
    time: float = 0.0
    before: float = 0.0
    after: float = 0.0

    def __str__(self) -> str:
        if self.first == self.last:
            return f"{self.source}, sample {self.first}"
        return f"{self.source}, samples {self.first} to {self.last}"


@dataclasses.dataclass(frozen=True)
class Finding(abc.ABC):
    """
    One defect of the data.

    :param channel: name of the channel, joint or command with the defect
    :param places: where it was found
    """

    blocks: ClassVar[bool] = False
    """Whether data with this defect cannot support a verdict."""

    remedy: ClassVar[str]
    """How to correct or avoid it."""

    channel: str
    places: tuple[Place, ...]

    @property
    @abc.abstractmethod
    def sentence(self) -> str:
        """The defect, in one sentence."""

    @property
    def where(self) -> str:
        """The first places, and how many more there are."""
        shown = "; ".join(map(str, self.places[:_SHOWN]))
        more = len(self.places) - _SHOWN
        return f"{shown}; and {counted(more, 'more place')}" if more > 0 else shown

    @property
    def recordings(self) -> str:
        """The first recordings that have the defect throughout, and how many more there are."""
        sources = list(dict.fromkeys(place.source for place in self.places))
        more = f" and {len(sources) - _SHOWN} more" if len(sources) > _SHOWN else ""
        return f"all samples of {', '.join(sources[:_SHOWN])}{more}"

    def __str__(self) -> str:
        return f"{self.sentence} {self.remedy}"

    def to_dict(self) -> dict[str, Any]:
        """:return: plain data for JSON"""
        fields = dataclasses.asdict(self)
        places = [place._asdict() for place in self.places]
        kind = {"kind": type(self).__name__, "blocks": self.blocks, "text": str(self)}
        return kind | fields | {"places": places}
