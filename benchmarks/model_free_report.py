"""
The tables and figures of ``model_free.py``: each method compared with its peers and its paper.

Intervals are those of means over seeds (see ``intervals.py``): rough for five seeds, and for two
little more than the range.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import intervals
import numpy as np
import pandas as pd
from model_free import CAR, CART_POLE, LENGTHS, OURS, PEERS, PENDULUM
from runs import RESULTS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: target return of every method; that of Gymnasium for the two small tasks
TARGETS = {PENDULUM: -150.0, CAR: 90.0, CART_POLE: 950.0}
#: mean and standard deviation over seeds, and their number, after some of the steps after which
#: ours are evaluated, on the tasks of -v4 for ours of -v5: from `results/baseline` and
#: `results/scaling/utd` (SimBa) of github.com/DAVIAN-Robotics/SimbaV2, commit 86899c2 (Lee et al.
#: 2025)
PUBLISHED = {
    ("HalfCheetah-v5", "sac"): {50_000: (4212.0, 498.0, 10), 100_000: (6156.0, 700.0, 10)},
    ("HalfCheetah-v5", "droq"): {50_000: (6383.0, 798.0, 10), 100_000: (7744.0, 1291.0, 10)},
    ("HalfCheetah-v5", "crossq_jax"): {
        10_000: (1148.0, 809.0, 10),
        50_000: (6345.0, 790.0, 10),
        100_000: (8112.0, 896.0, 10),
    },
    ("HalfCheetah-v5", "simba"): {50_000: (4022.0, 539.0, 10), 100_000: (5462.0, 598.0, 10)},
    ("HalfCheetah-v5", "bro"): {50_000: (6504.0, 1151.0, 5), 100_000: (8330.0, 1352.0, 5)},
    ("HalfCheetah-v5", "bro_fast"): {50_000: (4280.0, 521.0, 5), 100_000: (6516.0, 858.0, 5)},
    ("Hopper-v5", "sac"): {50_000: (530.0, 284.0, 10)},
    ("Hopper-v5", "droq"): {50_000: (1569.0, 1132.0, 10)},
    ("Hopper-v5", "crossq_jax"): {40_000: (2042.0, 1098.0, 10), 50_000: (1421.0, 910.0, 10)},
    ("Hopper-v5", "simba"): {50_000: (828.0, 263.0, 10)},
    ("Hopper-v5", "bro"): {50_000: (721.0, 371.0, 5)},
    ("Hopper-v5", "bro_fast"): {50_000: (631.0, 114.0, 5)},
}
#: range of returns that a second row of the figure shows alone
CLOSE_TO_THE_BEST = {PENDULUM: (-190.0, -134.0)}
#: returns up to which steps are counted: the pendulum swings up, and it does what all shall reach
GOALS = {PENDULUM: (-200.0, TARGETS[PENDULUM])}
#: methods that shall need fewer steps than another one for the return that this one ends with
FEWER_STEPS = (("droq", "sac"), ("droq", "sb3_sac"), ("droq", "sbx_sac"))


def report() -> None:
    """Print and write the tables, and draw the figures."""
    path = RESULTS / "model_free.csv"
    if not path.exists():
        print("Nothing has been measured yet.")
        return
    runs = in_order(pd.read_csv(path))
    if (paces := RESULTS / "model_free_pace.csv").exists():
        runs["seconds"] = wall_seconds(runs, pd.read_csv(paces))
    tables = {
        "summary": summary(runs),
        "peers": beside_peers(runs),
        "papers": beside_papers(runs),
        "fewer_steps": fewer_steps(runs),
    }
    for name, table in tables.items():
        if len(table):
            table.to_csv(RESULTS / f"model_free_{name}.csv", index=False, float_format="%.5g")
            print(f"\n{name.replace('_', ' ')}\n{shown(table)}")
    for env, some in runs.groupby("env"):
        figure(some, str(env))


def in_order(runs: pd.DataFrame) -> pd.DataFrame:
    """:return: the same rows, sorted by environment and method"""
    for column, order in (("method", [*OURS, *PEERS]), ("env", list(LENGTHS))):
        runs = runs.sort_values(column, key=lambda names: names.map(order.index), kind="stable")
    return runs.reset_index(drop=True)


def wall_seconds(runs: pd.DataFrame, paces: pd.DataFrame) -> pd.Series:
    """
    :param paces: of the methods, from ``model_free_pace.py``
    :return: for each row, seconds of training up to its mark; nan where the pace was not measured
    """
    rows = runs[["env", "method", "steps"]].merge(paces, "left", ["env", "method"])
    begun = (rows["steps"] / rows["first_steps"]).clip(upper=1.0) * rows["first_s"]
    later = (rows["steps"] - rows["first_steps"]).clip(lower=0.0) * rows["step_s"]
    return pd.Series((begun + later).to_numpy(), runs.index)


def shown(table: pd.DataFrame) -> str:
    return table.to_string(index=False, float_format="{:.5g}".format)


def summary(runs: pd.DataFrame) -> pd.DataFrame:
    """
    A row for each method at its last mark: mean return over seeds with its interval, the seconds
    that training took, and the steps after which the mean reached the target of its environment.
    """
    rows = []
    for (env, method), some in runs.groupby(["env", "method"], sort=False):
        last = some[some["mark"] == some["mark"].max()]
        returns = last["return"].to_numpy()
        mean, low, high = intervals.of_mean(returns)
        row = {"env": env, "method": method, "mark": last["mark"].iloc[0], "seeds": len(last)}
        row |= {"return": mean, "low": low, "high": high, "worst": returns.min()}
        row |= {"seconds": last["seconds"].mean()}
        if env in TARGETS:
            row["steps_to_target"] = first_mark(some, TARGETS[env])
        rows.append(row)
    return pd.DataFrame(rows)


def beside_peers(runs: pd.DataFrame) -> pd.DataFrame:
    """
    A row for each method of ours and each of its peers, at the last mark that both have. ``worse``:
    our mean lies below the interval of the peer's; nothing, where a single run has none.
    """
    rows = []
    for env, some in runs.groupby("env", sort=False):
        for method, ours in OURS.items():
            for peer in ours.peers:
                at = common_mark(some, method, peer)
                if at is None:
                    continue
                mine, theirs = (returns_at(some, name, at) for name in (method, peer))
                their_mean, their_low, _ = intervals.of_mean(theirs)
                difference, low, high = intervals.of_difference(mine, theirs)
                row = {"env": env, "method": method, "peer": peer, "mark": at}
                row |= {
                    "return": mine.mean(),
                    "return_of_peer": their_mean,
                    "low_of_peer": their_low,
                }
                row |= {"difference": difference, "low": low, "high": high}
                row |= {
                    "probability_of_improvement": intervals.probability_of_improvement(mine, theirs)
                }
                worse = "yes" if mine.mean() < their_low else "no"
                row |= {"worse": "" if np.isnan(their_low) else worse}
                rows.append(row | {"seeds": f"{len(mine)} and {len(theirs)}"})
    return pd.DataFrame(rows)


def beside_papers(runs: pd.DataFrame) -> pd.DataFrame:
    """
    A row for each published mean. ``z``: ours minus it, in its standard deviations over seeds;
    below -2, something is wrong. Narrow critics stand beside what was published of wide ones.
    """
    rows = []
    present = runs[["env", "method"]].drop_duplicates().itertuples(index=False)
    for env, method in present:
        some = runs[(runs["env"] == env) & (runs["method"] == method)]
        for at, (mean, deviation, n) in PUBLISHED.get((env, plain(method)), {}).items():
            reached = returns_at(some, method, at)
            if not len(reached):
                continue
            mine, low, high = intervals.of_mean(reached)
            row = {"env": env, "method": method, "mark": at, "seeds": len(reached)}
            row |= {"return": mine, "low": low, "high": high}
            row |= {"published": mean, "deviation": deviation, "published_seeds": n}
            rows.append(row | {"z": (mine - mean) / deviation})
    return pd.DataFrame(rows)


def fewer_steps(runs: pd.DataFrame) -> pd.DataFrame:
    """
    How many times fewer steps one method needs, in the median over seeds: for the mean return that
    another ends with, if that has learned the task, and for some returns of the environment. nan:
    one of them needs more than it has had.
    """
    rows = []
    for env, some in runs.groupby("env", sort=False):
        for method, other in FEWER_STEPS:
            theirs = some[some["method"] == other]
            mine = some[some["method"] == method]
            if not (len(mine) and len(theirs)):
                continue
            end = int(theirs["mark"].max())
            theirs_end = float(returns_at(theirs, other, end).mean())
            learned = theirs_end >= TARGETS.get(env, -np.inf)
            goals = {theirs_end: float(end)} if learned else {}
            goals |= {goal: median_first_mark(theirs, goal) for goal in GOALS.get(env, ())}
            for goal, theirs_needs in goals.items():
                needs = median_first_mark(mine, goal)
                row = {"env": env, "method": method, "peer": other, "target": goal, "steps": needs}
                row |= {"steps_of_peer": theirs_needs, "ratio": theirs_needs / needs}
                seeds = f"{mine['seed'].nunique()} and {theirs['seed'].nunique()}"
                rows.append(row | {"seeds": seeds})
    return pd.DataFrame(rows)


def median_first_mark(some: pd.DataFrame, goal: float) -> float:
    """:return: median over seeds of the first mark at which each reaches the goal; nan: never"""
    reached = (run.loc[run["return"] >= goal, "mark"] for _, run in some.groupby("seed"))
    median = np.median([min(marks, default=np.inf) for marks in reached])
    return float(median) if np.isfinite(median) else np.nan


def first_mark(some: pd.DataFrame, goal: float) -> float:
    """:return: the first mark at which the mean over seeds reaches the goal; nan: none"""
    means = some.groupby("mark")["return"].mean()
    reached = means.index[means >= goal]
    return float(reached[0]) if len(reached) else np.nan


def common_mark(some: pd.DataFrame, *methods: str) -> int | None:
    """:return: the last mark that all runs of these methods have; None: there is none"""
    if not set(methods) <= set(some["method"]):
        return None
    runs = some[some["method"].isin(methods)].groupby(["method", "seed"])
    return max(set.intersection(*(set(run["mark"]) for _, run in runs)), default=None)


def returns_at(some: pd.DataFrame, method: str, mark: int) -> np.ndarray:
    """:return: of every seed"""
    chosen = (some["method"] == method) & (some["mark"] == mark)
    return some.loc[chosen, "return"].to_numpy()


def figure(table: pd.DataFrame, env: str) -> None:
    """
    Return against steps and against wall time: a line for each method, a band over its seeds;
    beside them what was published, with its deviation. Peers have the colour of ours. Where the
    returns that matter lie close together, a second row shows the means there.
    """
    from matplotlib.figure import Figure

    near = CLOSE_TO_THE_BEST.get(env)
    n_rows = 1 if near is None else 2
    drawing = Figure(figsize=(10.0, 0.6 + 3.4 * n_rows), layout="constrained")
    rows = drawing.subplots(n_rows, 2, sharey="row", squeeze=False)
    for panels, with_bands in zip(rows, (True, False), strict=False):
        draw_curves(panels, table, env, with_bands)
        panels[0].set_ylabel(f"return on {env}")
    if near is not None:
        rows[1, 0].set_ylim(near)
        for panel in rows[1]:
            panel.axhline(TARGETS[env], color="black", linewidth=0.8, linestyle=":")
    rows[-1, 0].set_xlabel("steps in the environment")
    rows[-1, 1].set_xlabel("wall time of training [s]")
    rows[0, 1].legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.02))
    drawing.savefig(RESULTS / f"model_free_{env}.png", dpi=150)


def draw_curves(panels: Sequence["Axes"], table: pd.DataFrame, env: str, with_bands: bool) -> None:
    """
    :param panels: for returns against steps and against seconds
    :param with_bands: over seeds
    """
    from matplotlib.ticker import LogLocator

    present = set(table["method"])
    for method in (m for m in (*OURS, *PEERS) if m in present):
        runs = table[table["method"] == method].groupby("mark")
        middle, low, high = (runs["return"].agg(f) for f in ("mean", "min", "max"))
        style, seconds = style_of(method), runs["seconds"].mean()
        for panel, x in zip(panels, (middle.index, seconds), strict=True):
            marker = "o" if len(middle) == 1 else None
            panel.plot(x, middle, label=method, linewidth=1.5, marker=marker, **style)
            if with_bands:
                panel.fill_between(x, low, high, color=style["color"], alpha=0.12, linewidth=0.0)
    for method in {plain(method): None for method in OURS if method in present}:
        for mark, (mean, deviation, _) in PUBLISHED.get((env, method), {}).items():
            beside = 0.02 + 0.015 * list(OURS).index(method)
            at, colour = mark + beside * table["mark"].max(), style_of(method)["color"]
            panels[0].errorbar(at, mean, deviation, fmt="_", color=colour, alpha=0.6, capsize=2)
    if table["seconds"].notna().any():
        panels[1].set_xscale("log")
        panels[1].xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        panels[1].xaxis.set_major_formatter("{x:g}")
        panels[1].xaxis.set_minor_formatter("")


# Lines of critics that are narrower than in the papers.
_NARROW: dict[str, Any] = {"narrow": "-.", "512": (0, (6, 1))}


def style_of(method: str) -> dict[str, Any]:
    """:return: colour by algorithm, line by library, or for narrow critics"""
    from matplotlib import colormaps

    same = next(name for name, ours in OURS.items() if plain(method) in (name, *ours.peers))
    line = "-" if method in OURS else "--" if method.startswith("sbx") else ":"
    return {
        "color": colormaps["tab10"](list(OURS).index(same)),
        "linestyle": line if plain(method) == method else _NARROW[method.rpartition("_")[2]],
    }


def plain(method: str) -> str:
    """:return: the method that has this one's algorithm and the widths of its paper"""
    return method.removesuffix("_narrow").removesuffix("_512")
