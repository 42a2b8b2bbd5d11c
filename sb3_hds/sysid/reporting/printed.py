"""A diagnosis in 80 columns, part by part."""

import textwrap
from collections.abc import Mapping, Sequence

from sb3_hds.core import Twin
from sb3_hds.sysid.reporting import wording
from sb3_hds.sysid.reporting.finding import Finding, Rejected
from sb3_hds.sysid.reporting.sentence import spoken

WIDTH = 80
# Candidates whose smallest sizes are printed; all are in the report.
_MOST_SHOWN = 12
# Rejected candidates that get a line of their own.
_MOST_IN_TABLE = 5


def table_of(findings: Sequence[Finding]) -> list[str]:
    """Many causes, one line for each size."""
    rows = []
    for finding in findings:
        name = spoken(finding.key).replace(f" at {finding.where['name']}", "")
        own = finding.where["slot"] == "parameter"
        place = "" if own else finding.where["name"]
        share = "" if finding.share is None else f"{finding.share:.0%}"
        for e in finding.parameters.values():
            rows.append(
                (place, name, wording.size_in_words(e), wording.interval_in_words(e), share)
            )
    head = ("joint", "cause", "size", "90 % interval", "of force")
    widths = [max(len(row[k]) for row in [head, *rows]) for k in range(len(head))]
    lines = [
        "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in [head, *rows]
    ]
    alike = [
        f"{spoken(f.key)}: the data cannot tell it from {' or '.join(map(spoken, f.alternatives))}."
        for f in findings
        if f.alternatives
    ]
    return [*lines, *(line for text in alike for line in wrapped(text))]


def finding_in_lines(finding: Finding) -> list[str]:
    own, place = finding.where["slot"] == "parameter", finding.where["name"]
    lines = [finding.effect if own else f"{finding.effect} at {finding.where['slot']} {place}"]
    lines += wrapped(finding.explanation, "  ")
    for name, e in finding.parameters.items():
        said = f"{name} = {wording.size_in_words(e)}, standard error {e.stderr:.2g}, 90 % interval "
        lines += wrapped(f"{said}{wording.interval_in_words(e)}", "  ")
    lines += wrapped(wording.evidence_in_words(finding.gain, finding.p_value), "  ")
    if finding.alternatives:
        lines += wrapped(f"{wording.ALIKE} {', '.join(finding.alternatives)}.", "  ")
    return lines


def not_accepted(rejected: Sequence[Rejected]) -> list[str]:
    """The best as a table, and all others by the reason."""
    if not rejected:
        return []
    best, others = rejected[:_MOST_IN_TABLE], rejected[_MOST_IN_TABLE:]
    width = max(len(r.name) for r in best)
    lines = [f"{'Not accepted':<{width + 2}} {'gain':>9} {'p':>7}  why"]
    for r in best:
        gain, p_value = wording.share_in_words(r.gain), wording.p_value_in_words(r.p_value)
        row = f"  {r.name:<{width}} {gain:>9} {p_value:>7}  {r.why}"
        lines += [row] if len(row) <= WIDTH else [row.removesuffix(f"  {r.why}"), f"    {r.why}"]
    for why in dict.fromkeys(r.why for r in others):
        names = [
            r.name if why == wording.TOO_LITTLE else f"{r.name} {wording.share_in_words(r.gain)}"
            for r in others
            if r.why == why
        ]
        lines += wrapped(f"{why}: {', '.join(map(str.strip, names))}", "  ")
    return [*lines, *wrapped(f"({wording.REJECTED})", "  ")]


def would_have_shown(twin: Twin, detectable: Mapping[str, Mapping[str, float]]) -> list[str]:
    """:param detectable: by candidate and parameter, the smallest size that these data show"""
    shown = [
        f"  {key}: {words}"
        for key, sizes in detectable.items()
        if (words := wording.sizes_in_words(twin, key, sizes))
    ]
    lines = ["They would have shown, if it were no smaller than:"] if shown else []
    lines += [line for each in shown[:_MOST_SHOWN] for line in wrapped(each)]
    more = len(shown) - _MOST_SHOWN
    return [*lines, f"  and {more} more, in the report and in `detectable`"] if more > 0 else lines


def choice(finding: Finding) -> str:
    """With what cannot be told from it."""
    names = [spoken(key) for key in (finding.key, *finding.alternatives)]
    return names[0] if len(names) == 1 else f"either {' or '.join(names)}"


def wrapped(text: str, indent: str = "") -> list[str]:
    # A name that is longer than a line stays whole.
    return textwrap.wrap(
        text,
        WIDTH,
        initial_indent=indent,
        subsequent_indent=indent + "  ",
        break_long_words=False,
        break_on_hyphens=False,
    )
