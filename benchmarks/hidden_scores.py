"""The scores of `hidden_effects.py`: rates and their targets, tables, a figure."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from hidden_cases import EULERS, NULLS, SHARES
from rates import Score, as_table, middle, share, share_with_interval, sizes_of, wilson
from runs import RESULTS
from same_cause import right
from several_scores import PARTS as PARTS_OF_SEVERAL
from several_scores import RULE as RULE_OF_SEVERAL
from several_scores import SEVERAL

#: names that are right for the Euler twin, beside the verdict `unknown`: it is half a step late
LATE = ("sensor_delay", "action_delay")
VERDICTS = ("named", "ambiguous", "none", "unknown", "not_identifiable")
# Target for the time of a diagnosis [s].
_SECONDS = {"full": 60.0, "quick": 15.0}
_RULE, _GAIN = "rule: ", "gain: "
_TEXTS = ("truth", "same", "verdict", "named", "set", "more", "moved", "estimate")


def loaded(path: Path) -> pd.DataFrame:
    """:return: the table, with "null" as text instead of a missing value"""
    return pd.read_csv(path, keep_default_na=False, na_values=[""])


def prepared(table: pd.DataFrame) -> pd.DataFrame:
    """Add to each row whether a name was given, and whether that name and all names are right."""
    # pandas reads a text column without any text as numbers.
    texts = [name for name in table if name in _TEXTS or name.startswith((_RULE, RULE_OF_SEVERAL))]
    table = table.assign(**{name: table[name].astype(object).fillna("") for name in texts})
    judged = lambda column: [_right(row, row[column]) for _, row in table.iterrows()]  # noqa: E731
    later = [
        all(_right(row, name) for name in row["more"].split(";") if name)
        for _, row in table.iterrows()
    ]
    first = np.array(judged("named"), bool)
    return table.assign(
        spoke=table["verdict"].isin(["named", "ambiguous"]),
        right=first,
        all_right=first & later,
        within=judged("set"),
        disturbed=table["disturbance"] > 0.0,
    )


def _right(row: pd.Series, names: str) -> bool:
    return right(row["truth"], json.loads(row["same"]), names)


def scores(table: pd.DataFrame, budget: str) -> list[Score]:
    """:param table: as ``prepared``; cases with several causes have scores of their own"""
    table = table[table["kind"] != SEVERAL]
    nulls, effects = table[table["kind"].isin(NULLS)], table[table["kind"] == "effect"]
    outside, pairs = table[table["kind"] == "outside"], table[table["kind"] == "pair"]
    cases = table[table["kind"] != EULERS]
    alone, said = cases[cases["verdict"] == "named"], effects[effects["spoke"]]
    white = effects[~effects["disturbed"] & (effects["noise"] != "5 %")]
    every = pairs["set"] + ";" + pairs["more"]
    hits = [(_right(row, names)) for (_, row), names in zip(pairs.iterrows(), every, strict=True)]
    both = [
        all(right(truth, json.loads(row["same"]), names) for truth in row["truth"].split(";"))
        for (_, row), names in zip(pairs.iterrows(), every, strict=True)
    ]
    still = table[table["kind"] == "still"]
    sizes = pd.Series([len(names.split(";")) for names in said["set"]], dtype=float)
    named = nulls.groupby("kind")["spoke"] if len(nulls) else {}
    alarms = dict(iter(named))
    found = [share(f"false alarms: {k}", alarms.get(k, []), most=0.025) for k in NULLS]
    found += [share("nulls called unknown", nulls["verdict"] == "unknown")]
    found += [
        share("right among named verdicts", alone["all_right"], least=0.95),
        share(
            "right among named verdicts, single effects",
            alone["all_right"][alone.kind == "effect"],
        ),
        share("a wrong name, all data", cases["spoke"] & ~cases["all_right"]),
        share("right name: white noise up to 1 %", white["right"], least=0.9),
        share("right name: coloured disturbance", effects["right"][effects.disturbed], least=0.8),
        share(
            "right name: white noise of 5 %",
            effects["right"][~effects.disturbed & (effects.noise == "5 %")],
        ),
        share("truth within the reported set", said["within"], least=0.95),
        Score("mean size of the set", float(sizes.mean()), np.nan, np.nan, len(sizes)),
        share("refused: outside the catalogue", ~outside["spoke"], least=0.9),
        share("called unknown: outside the catalogue", outside["verdict"] == "unknown", least=0.9),
        share("refused: standing still", still["verdict"] == "not_identifiable", least=1.0),
        share("pairs: one cause named", hits),
        share("pairs: both named", both),
    ]
    covered, errors = sizes_of(effects)
    found += [
        share("90 % intervals that cover the truth", covered, least=0.85, most=0.95),
        middle("error of a parameter, median", errors),
        middle("error of a parameter, 90th percentile", errors, 0.9),
        middle(
            "gain relative to the true effect, median",
            said["at_the_end"] / said["oracle"],
            least=0.9,
        ),
        middle("seconds, median", cases["seconds"]),
        middle("seconds, 90th percentile", cases["seconds"], 0.9, most=_SECONDS[budget]),
    ]
    return found + _eulers(table[table["kind"] == EULERS])


def _eulers(rows: pd.DataFrame) -> list[Score]:
    """Right are a delay or `unknown`, and never a friction."""
    names = [[n for n in f"{r['set']};{r['more']}".split(";") if n] for _, r in rows.iterrows()]
    late = [
        bool(own or moved) and all(name.startswith(LATE) for name in own)
        for own, moved in zip(names, rows["moved"], strict=True)
    ]
    answered = (rows["verdict"] == "unknown") | np.array(late, bool)
    friction = [any("friction" in name or "drag" in name for name in own) for own in names]
    return [
        share(f"{EULERS}: delay or unknown", answered, least=1.0),
        share(f"{EULERS}: friction named", friction, most=0.0),
    ]


def by_difficulty(table: pd.DataFrame) -> pd.DataFrame:
    """Rates of single effects by noise, disturbance and size."""
    effects, rows = table[table["kind"] == "effect"], []
    for label, own in (
        ("white, up to 1 %", ~effects["disturbed"] & (effects["noise"] != "5 %")),
        ("white, 5 %", ~effects["disturbed"] & (effects["noise"] == "5 %")),
        ("coloured, up to 1 %", effects["disturbed"] & (effects["noise"] != "5 %")),
        ("coloured, 5 %", effects["disturbed"] & (effects["noise"] == "5 %")),
    ):
        for factor in (2.0, 4.0, 8.0):
            some = effects[own & (effects["factor"] == factor)]
            rows.append(
                {"noise": label, "size [detection limits]": f"{factor:.0f}"} | _rates_of(some)
            )
    return pd.DataFrame(rows)


def by_cause(table: pd.DataFrame) -> pd.DataFrame:
    """The same for each effect."""
    effects = table[table["kind"] == "effect"]
    effects = effects.assign(effect=effects["truth"].str.replace(r"\.[^.]*$", "", regex=True))
    rows = [{"effect": name} | _rates_of(own) for name, own in effects.groupby("effect")]
    return pd.DataFrame(rows)


def by_system(table: pd.DataFrame) -> pd.DataFrame:
    rows = []
    for name, own in table[table["kind"] != SEVERAL].groupby("system", sort=False):
        nulls, outside = own[own["kind"].isin(NULLS)], own[own["kind"] == "outside"]
        rows.append(
            {"system": name}
            | _rates_of(own[own["kind"] == "effect"])
            | {
                "false alarms": share_with_interval(nulls["spoke"]),
                "refused outside the catalogue": share_with_interval(~outside["spoke"]),
                "seconds": f"{own['seconds'].median():.0f}",
            }
        )
    return pd.DataFrame(rows)


def by_kind(table: pd.DataFrame) -> pd.DataFrame:
    """Every verdict on every kind of case."""
    rows = []
    for kind in (*SHARES, EULERS):
        own = table[table["kind"] == kind]
        if own.empty:
            continue
        counts = own["verdict"].value_counts()
        rows.append(
            {"kind": kind, "cases": len(own)}
            | {verdict.replace("_", " "): int(counts.get(verdict, 0)) for verdict in VERDICTS}
        )
    return pd.DataFrame(rows)


def by_outside(table: pd.DataFrame) -> pd.DataFrame:
    """How often each cause outside the catalogue is refused, and how."""
    outside = table[table["kind"] == "outside"]
    return pd.DataFrame(
        {
            "cause": name.replace("_", " "),
            "refused": share_with_interval(~own["spoke"]),
            "called unknown": share_with_interval(own["verdict"] == "unknown"),
        }
        for name, own in outside.groupby("truth")
    )


def by_rule(table: pd.DataFrame) -> pd.DataFrame:
    """Compare other rules with `diagnose` on the cases that all of them were applied to."""
    asked = table[table["asked"].astype(bool) & (table["kind"] != SEVERAL)]
    rules = [name.removeprefix(_RULE) for name in table if name.startswith(_RULE)]
    rows = [_of_rule("diagnose", asked, asked["named"], asked["at_the_end"])]
    for rule in rules:
        rows.append(_of_rule(rule, asked, asked[f"{_RULE}{rule}"], asked[f"{_GAIN}{rule}"]))
    return pd.DataFrame(rows)


def _of_rule(rule: str, asked: pd.DataFrame, names: pd.Series, gains: pd.Series) -> dict[str, str]:
    spoke, effect = names != "", asked["kind"] == "effect"
    good = pd.Series(
        [_right(row, name) for (_, row), name in zip(asked.iterrows(), names, strict=True)],
        asked.index,
        bool,
    )
    ratio = (gains / asked["oracle"])[effect & spoke]
    median = f"{np.nanmedian(ratio):.2f}" if ratio.notna().any() else "-"
    return {
        "rule": rule,
        "false alarms": share_with_interval(spoke[asked["kind"].isin(NULLS)]),
        "named outside the catalogue": share_with_interval(spoke[asked["kind"] == "outside"]),
        "right": share_with_interval(good[effect]),
        "wrong": share_with_interval((spoke & ~good)[effect]),
        "gain relative to the true effect": median,
    }


def _rates_of(rows: pd.DataFrame) -> dict[str, str]:
    return {
        "right": share_with_interval(rows["right"]),
        "exact name": _share(rows["truth"] == rows["named"]),
        "within the set": _share(rows["within"][rows["spoke"]]),
        "wrong": _share(rows["spoke"] & ~rows["right"]),
        "none": _share(rows["verdict"] == "none"),
        "unknown": _share(rows["verdict"] == "unknown"),
    }


def _share(hits: pd.Series) -> str:
    return f"{hits.mean():.2f}" if len(hits) else "-"


PARTS: dict[str, Callable[[pd.DataFrame], pd.DataFrame]] = {
    "kinds": by_kind,
    "difficulty": by_difficulty,
    "causes": by_cause,
    "systems": by_system,
    "outside": by_outside,
    "rules": by_rule,
}


def report(name: str) -> None:
    """Print ``results/NAME.csv``, and write its tables and its picture beside it."""
    path = RESULTS / f"{name}.csv"
    if not path.exists():
        print(f"{path} does not exist: nothing has been run.")
        return
    table, budget = prepared(loaded(path)), "quick" if name.endswith("quick") else "full"
    found = scores(table, budget)
    print(f"{len(table)} cases")
    _write(as_table(found), f"{name}_targets")
    for part, condensed in PARTS.items():
        _write(condensed(table), f"{name}_{part}")
    if len(several := table[table["kind"] == SEVERAL]):
        for part, condensed in PARTS_OF_SEVERAL.items():
            _write(condensed(several), f"{name}_{part}")
    figure(found, table, name)
    wrong = table[table["spoke"] & ~table["within"] & ~table["kind"].isin((EULERS, SEVERAL))]
    columns = ["system", "case", "kind", "truth", "factor", "noise", "disturbance", "set"]
    if len(wrong):
        print(f"Wrong:\n{wrong[columns].to_string(index=False)}")


def _write(table: pd.DataFrame, name: str) -> None:
    print(f"\n{name}\n{table.to_string(index=False)}")
    temporary = RESULTS / f"{name}.tmp"
    table.to_csv(temporary, index=False)
    temporary.replace(RESULTS / f"{name}.csv")


def figure(found: Sequence[Score], table: pd.DataFrame, name: str) -> None:
    """Rates with their intervals against targets; right names against size."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(10.0, 4.6), layout="constrained")
    left, middle_ = drawing.subplots(1, 2, width_ratios=(3, 2))
    rates = [s for s in found if s.target and np.isfinite(s.low)]
    for place, s in enumerate(reversed(rates)):
        colour = "#2c6e49" if s.reached == "yes" else "#b3392f"
        left.plot([s.low, s.high], [place, place], color=colour, lw=2.0)
        left.plot(s.value, place, "o", color=colour)
        for end in (s.least, s.most):
            if end is not None:
                left.plot([end, end], [place - 0.35, place + 0.35], color="black", lw=1.2)
    left.set_yticks(range(len(rates)), [s.label for s in reversed(rates)], fontsize=8)
    left.set_xlim(-0.02, 1.02)
    left.set_xlabel("share of the cases, 95 % interval; bars: targets, green: reached")
    effects = table[table["kind"] == "effect"]
    for label, own, colour, aside in (
        ("white, up to 1 %", ~effects["disturbed"] & (effects["noise"] != "5 %"), "#27496d", 0.97),
        ("white, 5 %", ~effects["disturbed"] & (effects["noise"] == "5 %"), "#7fa6cc", 1.0),
        ("coloured", effects["disturbed"], "#c98a2b", 1.03),
    ):
        groups = effects[own].groupby("factor")["right"]
        sizes, means = aside * groups.mean().index.to_numpy(), groups.mean()
        ends = np.array([wilson(int(g.sum()), len(g)) for _, g in groups]).reshape(-1, 2)
        spans = np.abs(ends.T - means.to_numpy())
        middle_.errorbar(sizes, means, spans, fmt="o-", color=colour, label=label, capsize=2)
    middle_.set_xscale("log", base=2)
    middle_.set_xticks((2, 4, 8), ("2", "4", "8"))
    middle_.set_ylim(0.0, 1.03)
    middle_.set_xlabel("size, in detection limits")
    middle_.set_ylabel("right name")
    middle_.legend(frameon=False)
    drawing.savefig(RESULTS / f"{name}.png", dpi=150)
