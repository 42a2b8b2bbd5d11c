"""The scores of cases with several causes at once: rates and their targets, tables."""

import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from rates import Score, as_table, middle, share, share_with_interval, sizes_of

SEVERAL = "several"
RULE = "several: "
# Target for the time of a verdict by number of joints [s], with any cache.
_SECONDS = {1: 10.0, 2: None, 3: None, 6: 60.0}


class CaseScore(NamedTuple):
    """
    The score of one case.

    :param named: for each detectable planted cause, whether it was named
    :param within: for each of them, whether it was named or in the set of a finding
    :param right: for each finding, whether its name is a planted cause
    :param among: for each finding, whether its name or an alternative in its set is a planted cause
    :param alone: for each finding without alternatives, whether its name is a planted cause
    """

    named: list[bool]
    within: list[bool]
    right: list[bool]
    among: list[bool]
    alone: list[bool]

    @property
    def flawless(self) -> bool:
        """All names are right, and none is missing."""
        return all(self.right) and all(self.named)

    @property
    def flawless_with_sets(self) -> bool:
        return all(self.among) and all(self.within)


def score_case(
    truths: Sequence[str],
    visible: Sequence[bool],
    same: Mapping[str, Sequence[str]],
    sets: Sequence[Sequence[str]],
) -> CaseScore:
    """
    :param truths: names of all planted causes, with their places
    :param visible: whether each is above twice the detection limit
    :param same: equivalent names in these data, by planted cause
    :param sets: for each finding, its name and its alternatives
    """
    meant = [{truth, *same.get(truth, ())} for truth in truths]
    shown = [own for own, visible_ in zip(meant, visible, strict=True) if visible_]
    names, every = {s[0] for s in sets}, {name for s in sets for name in s}
    right = lambda names: any(own & {*names} for own in meant)  # noqa: E731
    return CaseScore(
        named=[bool(own & names) for own in shown],
        within=[bool(own & every) for own in shown],
        right=[right(s[:1]) for s in sets],
        among=[right(s) for s in sets],
        alone=[right(s) for s in sets if len(s) == 1],
    )


def of_diagnose(rows: pd.DataFrame) -> list[CaseScore]:
    return [
        score_case(
            row["truth"].split(";"),
            json.loads(row["visible"]),
            json.loads(row["same"]),
            json.loads(row["sets"]),
        )
        for _, row in rows.iterrows()
    ]


def of_rule(rows: pd.DataFrame, rule: str) -> list[CaseScore]:
    found = []
    for _, row in rows.iterrows():
        said = json.loads(row[f"{RULE}{rule}"])
        sets = [[name] for name in said["names"]]
        visible = json.loads(row["visible"])
        found.append(score_case(row["truth"].split(";"), visible, said["same"], sets))
    return found


def _every(found: Sequence[CaseScore], field: str) -> list[bool]:
    return [hit for one in found for hit in getattr(one, field)]


def scores(rows: pd.DataFrame) -> list[Score]:
    """:param rows: cases with several causes"""
    found = of_diagnose(rows)
    covered, errors = sizes_of(rows)
    visible = [shown for text in rows["visible"] for shown in json.loads(text)]
    return [
        share("detectable planted causes: named or in a set", _every(found, "within"), least=0.95),
        share("detectable planted causes: named", _every(found, "named")),
        share("names that are right", _every(found, "right"), least=0.97),
        share("names without an alternative that are right", _every(found, "alone")),
        share("cases: all right, none missing", [one.flawless for one in found], least=0.85),
        share("the same, sets included", [one.flawless_with_sets for one in found]),
        share("90 % intervals that cover the truth", covered, least=0.85, most=0.95),
        middle("error of a parameter, median", errors),
        share("planted causes that are detectable", visible),
        *(
            middle(
                f"seconds, {joints} joint{'s' if joints > 1 else ''}, median",
                rows["seconds"][rows["joints"] == joints],
                **({"most": most} if most else {}),
            )
            for joints, most in _SECONDS.items()
        ),
    ]


def targets(rows: pd.DataFrame) -> pd.DataFrame:
    return as_table(scores(rows))


def by_condition(rows: pd.DataFrame) -> pd.DataFrame:
    """By number of joints, and by how the rig was driven and recorded."""
    servos = rows["system"].str.endswith("servos")
    conditions = {
        **{f"{n} joint{'s' if n > 1 else ''}": rows["joints"] == n for n in _SECONDS},
        "open loop": (rows["loop"] == "open") & ~servos,
        "position loop": rows["loop"] == "position",
        "velocity loop": rows["loop"] == "velocity",
        "loop in the model": servos,
        "positions and velocities": rows["seen"] == "qv",
        "positions only": rows["seen"] == "q",
        "several recordings": rows["recordings"] > 1,
        "one long recording": rows["recordings"] == 1,
        "two or three causes": rows["causes"] <= 3,
        "four to six": rows["causes"].between(4, 6),
        "seven to nine": rows["causes"] >= 7,
    }
    return pd.DataFrame(
        {"condition": name} | _row(of_diagnose(own := rows[chosen]), own, own["seconds"])
        for name, chosen in conditions.items()
    )


def by_rule(rows: pd.DataFrame) -> pd.DataFrame:
    """Compare each other method with `diagnose` on the cases that it was applied to."""
    found = []
    for rule in (name.removeprefix(RULE) for name in rows if name.startswith(RULE)):
        own = rows[rows[f"{RULE}{rule}"] != ""]
        seconds = pd.Series([json.loads(x)["seconds"] for x in own[f"{RULE}{rule}"]], dtype=float)
        found.append({"rule": rule} | _row(of_rule(own, rule), own, seconds))
        found.append({"rule": "diagnose, same cases"} | _row(of_diagnose(own), own, own["seconds"]))
    return pd.DataFrame(found)


def _row(found: Sequence[CaseScore], rows: pd.DataFrame, seconds: pd.Series) -> dict[str, Any]:
    names = sum(len(one.right) for one in found)
    return {
        "cases": len(rows),
        "causes named or in a set": share_with_interval(_every(found, "within")),
        "names right": share_with_interval(_every(found, "right")),
        "names per case": f"{names / len(rows):.1f}" if len(rows) else "-",
        "all right, none missing": share_with_interval([one.flawless for one in found]),
        "seconds": f"{np.median(seconds):.1f}" if len(rows) else "-",
    }


PARTS = {"several": targets, "several_conditions": by_condition, "several_rules": by_rule}
