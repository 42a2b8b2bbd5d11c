"""A diagnosis in words: causes in one sentence, and all results in 80 columns."""

import textwrap
from collections.abc import Mapping, Sequence

from sb3_hds.core import Twin
from sb3_hds.sysid.estimation.candidates import EVERY
from sb3_hds.sysid.reporting import wording
from sb3_hds.sysid.reporting.finding import Finding, Rejected
from sb3_hds.sysid.reporting.wording import with_unit

WIDTH = 80
# Candidates whose smallest sizes are printed; all are in the report.
_MOST_SHOWN = 12
# Rejected candidates that get a line of their own.
_MOST_IN_TABLE = 5
_NUMBERS = (
    *("no", "one", "two", "three", "four", "five", "six"),
    *("seven", "eight", "nine", "ten", "eleven", "twelve"),
)
# Effects that are summed up over all joints first, in the order of their mention.
_FRICTION = (
    *("viscous_friction", "directional_viscous_friction", "concave_friction"),
    *("coulomb_friction", "directional_coulomb_friction"),
    *("stribeck_friction", "load_dependent_friction"),
)
_SHARED = {
    "action_delay": "commands arrive {} late at all actuators",
    "motor_lag": "all motors lag by {}",
}
#: of the table of causes
COLUMNS = ("joint", "cause", "size", "90 % interval", "of force")
# Nouns without an article, and the number of ambiguous causes from which they are only counted.
_UNCOUNTED = ("stiffness", "cogging", "drag", "friction", "elasticity", "backlash", "saturation")
_MANY_DOUBTS = 3


def spoken(key: str) -> str:
    """:return: a candidate in words: Coulomb friction at hinge for ``"coulomb_friction.hinge"``"""
    name, _, place = key.partition(".")
    if name == "parameter":
        return place
    return f"{_plain(name)} at {'all actuators' if place == EVERY else place}"


def _plain(effect: str) -> str:
    for person in ("coulomb", "stribeck"):
        effect = effect.replace(person, person.title())
    return effect.replace("load_dependent", "load-dependent").replace("_", " ")


def several_in_words(findings: Sequence[Finding], joints: Sequence[str]) -> str:
    """
    :param findings: more than a few
    :param joints: names of all joints of the machine
    :return: a sentence: friction of all joints first, then the other causes
    """
    friction = [f for f in findings if f.effect in _FRICTION and f.where["slot"] == "joint"]
    rest = [f for f in findings if f not in friction]
    shared = [f for f in rest if f.where["name"] == EVERY]
    offsets = [f for f in rest if f.effect == "constant_force"]
    single = [f for f in rest if f not in shared and f not in offsets]
    besides = _listed([*map(_of_all, shared), *_offsets(offsets), *map(_one, single)])
    head = _friction_of(friction, joints)
    told = f"{head}; {besides} besides." if head and rest else f"{head or besides}."
    return f"{told[:1].upper()}{told[1:]}"


def _friction_of(findings: Sequence[Finding], joints: Sequence[str]) -> str:
    """Friction of all joints, by kind where joints differ."""
    groups: dict[tuple[str, ...], list[str]] = {}
    for joint in joints:
        own = {f.effect for f in findings if f.where["name"] == joint}
        if own:
            groups.setdefault(tuple(n for n in _FRICTION if n in own), []).append(joint)
    where = [joint for own in groups.values() for joint in own]
    if not where:
        return ""
    where.sort(key=list(joints).index)
    subject = f"{_places(where, joints)} {_verb(where)}"
    if len(groups) == 1:
        (kinds,) = groups
        carried = _carried(findings, "they carry" if len(kinds) > 1 else "it carries")
        return f"{subject} {_kinds(kinds)} that the model lacks{carried}"
    carried = _carried(findings, "it carries")
    largest = sorted(groups.items(), key=lambda group: -len(group[1]))
    by_kind = "; ".join(f"{_kinds(kinds)} at {_listed(own)}" for kinds, own in largest)
    return f"{subject} friction that the model lacks{carried}: {by_kind}"


def _of_all(finding: Finding) -> str:
    """What all actuators share."""
    effect = finding.effect
    how = _SHARED.get(effect, f"all actuators have {_article(_plain(effect))} of {{}}")
    return how.format(_size(finding))


def _offsets(findings: Sequence[Finding]) -> list[str]:
    if not findings:
        return []
    where, sizes = [f.where["name"] for f in findings], [_size(f) for f in findings]
    what = "an offset" if len(findings) == 1 else "offsets"
    return [f"{_listed(where)} {_verb(where)} {what} of {_listed(sizes)}"]


def _one(finding: Finding) -> str:
    name = finding.where["name"]
    if finding.where["slot"] == "parameter":
        first = next(iter(finding.parameters.values()))
        return f"{name} is {_size(finding)}, not {first.before:.2g}"
    return f"{name} has {_article(_plain(finding.effect))} of {_size(finding)}"


def _size(finding: Finding) -> str:
    """The first of its parameters that is not zero."""
    every = list(finding.parameters.values())
    told = next((e for e in every if e.estimate != 0.0), every[0])
    return with_unit(f"{told.estimate:.2g}", told.unit)


def _article(name: str) -> str:
    if name.endswith(_UNCOUNTED):
        return name
    return f"{'an' if name[:1] in 'aeiou' else 'a'} {name}"


def doubts_in_words(findings: Sequence[Finding]) -> str:
    """:return: a sentence on causes that have alternatives; empty if there are none"""
    doubtful = [f for f in findings if f.alternatives]
    if len(doubtful) > _MANY_DOUBTS:
        n = _number(len(doubtful))
        return f"Of {n} causes the data leave open which of several names is right."
    doubt = [f"{spoken(f.key)} from {' or '.join(map(spoken, f.alternatives))}" for f in doubtful]
    return f"The data cannot tell {'; '.join(doubt)}." if doubt else ""


def _places(where: Sequence[str], joints: Sequence[str]) -> str:
    if len(where) == len(joints) and len(joints) > 1:
        return "both joints" if len(joints) == 2 else f"all {_number(len(joints))} joints"
    return _listed(list(where))


def _number(n: int) -> str:
    return _NUMBERS[n] if n < len(_NUMBERS) else str(n)


def _verb(where: Sequence[str]) -> str:
    return "have" if len(where) > 1 else "has"


def _kinds(names: Sequence[str]) -> str:
    return f"{' and '.join(_plain(name).removesuffix(' friction') for name in names)} friction"


def _carried(own: Sequence[Finding], verb: str) -> str:
    by_joint: dict[str, float] = {}
    for f in own:
        if f.share is None:
            return ""
        by_joint[f.where["name"]] = by_joint.get(f.where["name"], 0.0) + f.share**2
    shares = [min(total**0.5, 1.0) for total in by_joint.values()]
    low, high = f"{min(shares):.0%}"[:-1], f"{max(shares):.0%}"[:-1]
    units = [e.unit for f in own for e in f.parameters.values()]
    what = "torque" if any("N m" in unit for unit in units) else "force"
    return f" ({verb} {high if low == high else f'{low} to {high}'} % of the {what})"


def _listed(items: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(items[:-1]), *items[-1:])))


def rows_of(findings: Sequence[Finding], joints: Sequence[str]) -> list[tuple[str, ...]]:
    """
    :param joints: names of all joints, by which causes are ordered; other places come last
    :return: :data:`COLUMNS` for each parameter of each cause
    """
    order = dict(zip(joints, range(len(joints)), strict=True))
    rows = []
    for finding in sorted(findings, key=lambda f: order.get(f.where["name"], len(order))):
        name = spoken(finding.key).replace(f" at {finding.where['name']}", "")
        own = finding.where["slot"] == "parameter"
        place = "" if own else finding.where["name"]
        share = "" if finding.share is None else f"{finding.share:.0%}"
        rows += [
            (place, name, wording.size_in_words(e), wording.interval_in_words(e), share)
            for e in finding.parameters.values()
        ]
    return rows


def table_of(findings: Sequence[Finding], joints: Sequence[str]) -> list[str]:
    """Many causes, one line for each parameter."""
    rows = [COLUMNS, *rows_of(findings, joints)]
    widths = [max(len(row[k]) for row in rows) for k in range(len(COLUMNS))]
    lines = [
        "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
    return [*lines, *(line for text in alike_in_words(findings) for line in wrapped(text))]


def alike_in_words(findings: Sequence[Finding]) -> list[str]:
    """:return: a sentence on each cause that has alternatives"""
    return [
        f"{spoken(f.key)}: the data cannot tell it from {' or '.join(map(spoken, f.alternatives))}."
        for f in findings
        if f.alternatives
    ]


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
    """The best rejected candidates as a table, and all others by reason."""
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
    """:return: a cause in words, with its alternatives"""
    names = [spoken(key) for key in (finding.key, *finding.alternatives)]
    return names[0] if len(names) == 1 else f"either {' or '.join(names)}"


def wrapped(text: str, indent: str = "") -> list[str]:
    # A name that is longer than a line is not broken.
    return textwrap.wrap(
        text,
        WIDTH,
        initial_indent=indent,
        subsequent_indent=indent + "  ",
        break_long_words=False,
        break_on_hyphens=False,
    )
