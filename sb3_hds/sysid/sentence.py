"""What several causes at once are called in a sentence."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from sb3_hds.sysid.results import Estimate
from sb3_hds.sysid.units import with_unit

_NUMBERS = (
    *("no", "one", "two", "three", "four", "five", "six"),
    *("seven", "eight", "nine", "ten", "eleven", "twelve"),
)
# What is said of a machine as a whole before anything else.
_FRICTION = ("viscous_friction", "coulomb_friction")


class Found(Protocol):
    """What is told of a cause."""

    @property
    def effect(self) -> str: ...
    @property
    def key(self) -> str: ...
    @property
    def where(self) -> Mapping[str, Any]: ...
    @property
    def parameters(self) -> Mapping[str, Estimate]: ...
    @property
    def share(self) -> float | None: ...
    @property
    def alternatives(self) -> Sequence[str]: ...


def spoken(key: str) -> str:
    """A candidate, for people: ``"coulomb_friction.hinge"`` is Coulomb friction at hinge."""
    name, _, place = key.partition(".")
    for person in ("coulomb", "stribeck"):
        name = name.replace(person, person.title())
    return place if name == "parameter" else f"{name.replace('_', ' ')} at {place}"


def several_in_words(findings: Sequence[Found], joints: Sequence[str]) -> str:
    """
    :param findings: more than a few
    :param joints: names of all joints of the machine
    :return: a sentence: friction of the machine as a whole first, and what there is besides; and
        one on what the data cannot tell from other causes
    """
    doubt = [
        f"{spoken(f.key)} from {' or '.join(map(spoken, f.alternatives))}"
        for f in findings
        if f.alternatives
    ]
    open_ = f" The data cannot tell {'; '.join(doubt)}." if doubt else ""
    return f"{_of_machine(findings, joints)}{open_}"


def _of_machine(findings: Sequence[Found], joints: Sequence[str]) -> str:
    friction = {
        joint: tuple(n for n in _FRICTION if any(_is(f, n, joint) for f in findings))
        for joint in joints
    }
    groups: dict[tuple[str, ...], list[str]] = {}
    for joint, names in friction.items():
        if names:
            groups.setdefault(names, []).append(joint)
    said = []
    for names, where in sorted(groups.items(), key=lambda group: -len(group[1])):
        own = [f for f in findings if f.effect in names and f.where["name"] in where]
        said.append(f"{_places(where, joints)} {_verb(where)} {_kinds(names)}{_carried(own)}")
    head = ", and ".join(said)
    if head:
        head += " that the model lacks"
    rest = [f for f in findings if not (f.effect in _FRICTION and f.where["slot"] == "joint")]
    besides = _listed([_one(f) for f in rest])
    if not head:
        return f"{besides[:1].upper()}{besides[1:]}."
    head = f"{head[:1].upper()}{head[1:]}"
    return f"{head}; {besides} besides." if rest else f"{head}."


def _is(finding: Found, effect: str, joint: str) -> bool:
    return finding.effect == effect and finding.where["name"] == joint


def _places(where: Sequence[str], joints: Sequence[str]) -> str:
    if len(where) == len(joints) and len(joints) > 1:
        n = _NUMBERS[len(joints)] if len(joints) < len(_NUMBERS) else str(len(joints))
        return "both joints" if len(joints) == 2 else f"all {n} joints"
    return _listed(list(where))


def _verb(where: Sequence[str]) -> str:
    return "have" if len(where) > 1 else "has"


def _kinds(names: Sequence[str]) -> str:
    short = {"viscous_friction": "viscous", "coulomb_friction": "Coulomb"}
    return f"{' and '.join(short[name] for name in names)} friction"


def _carried(own: Sequence[Found]) -> str:
    by_joint: dict[str, float] = {}
    for f in own:
        if f.share is None:
            return ""
        by_joint[f.where["name"]] = by_joint.get(f.where["name"], 0.0) + f.share**2
    shares = [min(total**0.5, 1.0) for total in by_joint.values()]
    low, high = f"{min(shares):.0%}"[:-1], f"{max(shares):.0%}"[:-1]
    units = [e.unit for f in own for e in f.parameters.values()]
    what = "torque" if any("N m" in unit for unit in units) else "force"
    return f" ({'it carries' if len(shares) == 1 else 'they carry'} " + (
        f"{high} % of the {what})" if low == high else f"{low} to {high} % of the {what})"
    )


def _one(finding: Found) -> str:
    first = next(iter(finding.parameters.values()))
    size = with_unit(f"{first.estimate:.2g}", first.unit)
    if finding.where["slot"] == "parameter":
        return f"{finding.where['name']} is {size}, not {first.before:.2g}"
    name, place = spoken(finding.key).rsplit(" at ", 1)
    if finding.effect == "constant_force":
        return f"{place} has an offset of {size}"
    return f"{place} has {name} ({size})"


def _listed(items: Sequence[str]) -> str:
    return (
        items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}" if items else ""
    )
