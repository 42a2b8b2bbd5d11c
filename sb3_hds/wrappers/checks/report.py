"""Reports of checks, printed in 80 columns."""

import dataclasses
import textwrap
from typing import Any

from sb3_hds.data.wording import counted

_WIDTH = 80


@dataclasses.dataclass(frozen=True, repr=False)
class Report:
    """
    The result of a check.

    :param subject: what was checked, and on how much data
    :param problems: one paragraph each: what was measured, why it matters, what to do
    :param notes: what could not be checked, and further remarks
    """

    subject: str
    problems: list[str]
    notes: list[str]

    @property
    def ok(self) -> bool:
        """Whether there is no problem."""
        return not self.problems

    def __str__(self) -> str:
        verdict = "no problem found" if self.ok else counted(len(self.problems), "problem")
        paragraphs = [textwrap.fill(f"{self.subject}: {verdict}.", _WIDTH)]
        paragraphs += [_item(f"{i}. ", text) for i, text in enumerate(self.problems, 1)]
        paragraphs += [_item("Note: ", text) for text in self.notes]
        return "\n\n".join(paragraphs)

    __repr__ = __str__


def name_of(env: Any) -> str:
    """:return: the id of an environment, or else its class"""
    spec = getattr(env, "spec", None)
    if spec is not None:
        return spec.id
    bare = getattr(env, "unwrapped", env)
    return type(bare).__name__


def _item(mark: str, text: str) -> str:
    return textwrap.fill(text, _WIDTH, initial_indent=mark, subsequent_indent=" " * len(mark))
