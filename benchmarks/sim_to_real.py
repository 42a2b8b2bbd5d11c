"""
The gap between simulation and reality, and how much of it each method closes per real step.

    python benchmarks/sim_to_real.py                       # all cells and methods, five seeds
    python benchmarks/sim_to_real.py --cells heavy --seeds 2 --jobs 1
    python benchmarks/sim_to_real.py --figure              # redraw the figure from the table

Each cell is a stand-in for hardware that its data sheet describes wrongly. Wrong twin, HDS and
domain randomisation know the data sheet; the ceiling is PODS in the true twin. Every policy is
evaluated on the same 50 start states of the real system. Finished runs are kept, so an interrupted
benchmark resumes. Only cells whose gap (ceiling minus wrong twin) exceeds three standard errors
count; a twin that is wrong only in its steps is reported apart from the medians. Medians over cells
have 90 % bootstrap intervals that resample seeds within each cell, as recommended by Agarwal et al.
2021 (rliable's stratified bootstrap, in which a seed's wrong twin and ceiling are drawn together
with it).
"""

import argparse
from functools import partial

import numpy as np
import pandas as pd
from hardware import CELLS, OTHER_TWIN, length_of, make, pretrained, return_of
from runs import CACHE, RESULTS, arguments_of, fresh_process, resume, seconds_since_start

METHODS = ("ceiling", "wrong_twin", "randomised", "hds", "sac", "tqc", "droq")
_DEEPEST = 1800.0  # below the best return, in the figure
_LEAST_SHOWN, _MOST_SHOWN = -0.4, 1.3  # shares of a gap, in the figure
STEPS = (1, 5, 10)  # real episodes after which learners are evaluated
SWEEP = [cell for cell in CELLS if cell != "worn"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--cells", nargs="*", default=SWEEP)
    parser.add_argument("--methods", nargs="*", default=list(METHODS))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--figure", action="store_true")
    arguments = arguments_of(parser, worker)
    if not arguments.figure:
        wanted = [
            (cell, method, seed)
            for seed in range(arguments.seeds)
            for cell in arguments.cells
            for method in arguments.methods
        ]
        in_process = partial(fresh_process, __file__, cache=CACHE)
        resume("sim_to_real", ("cell", "method", "seed"), wanted, in_process, arguments.jobs)
    report()


def worker(cell: str, method: str, seed: int) -> list[dict]:
    """Train once; evaluate after each number of real episodes."""
    if method in ("ceiling", "wrong_twin", "randomised"):
        return [evaluated(planner(method, cell, seed), cell, 0)]
    model, rows = learner(method, cell, seed), []
    for episodes in STEPS:
        missing = episodes * length_of(cell) - model.num_timesteps
        model.learn(missing, reset_num_timesteps=False)
        rows.append(evaluated(model, cell, episodes))
    return rows


def planner(method: str, cell: str, seed: int):
    """HDS without data is PODS with the planning settings of HDS."""
    from sb3_hds import HDS, envs

    if method == "ceiling":
        env = make(cell)
        return HDS(env, twin=envs.true_twin(env), seed=seed).learn(0)
    return pretrained(cell, seed, **({"randomisation": 1.0} if method == "randomised" else {}))


def learner(method: str, cell: str, seed: int):
    """
    SAC and TQC are SBX's, with the hyperparameters of RL Zoo for Pendulum-v1; DroQ is ours, with
    the same learning rate.
    """
    if method == "hds":
        return pretrained(cell, seed)
    import sbx

    import sb3_hds

    algorithm = {"sac": sbx.SAC, "tqc": sbx.TQC, "droq": sb3_hds.DroQ}[method]
    return algorithm("MlpPolicy", make(cell), seed=seed, learning_rate=1e-3)


def evaluated(model, cell: str, episodes: int) -> dict:
    seconds = seconds_since_start()
    return {
        "episodes": episodes,
        "real_steps": model.num_timesteps,
        "return": return_of(model, cell),
        "seconds": seconds,
    }


def report() -> None:
    table = pd.read_csv(RESULTS / "sim_to_real.csv")
    shown = closed(table)
    if shown.empty:
        print(
            "A gap needs a cell with both the wrong twin and the ceiling; none has run with both."
        )
        return
    wide = by_cell(table, shown)
    wide.to_csv(RESULTS / "sim_to_real_gap.csv", float_format="%.4g")
    print(wide.to_string(float_format=lambda x: f"{x:.2f}"))
    counts = wide["counts"].astype(bool) & ~wide.index.isin(OTHER_TWIN)
    medians = over_cells(table, list(wide.index[counts]))
    medians.to_csv(RESULTS / "sim_to_real_median.csv", index=False, float_format="%.4g")
    print(medians.to_string(index=False, float_format=lambda x: f"{x:.2f}"))
    leads = seed_by_seed(table[~table["cell"].isin(OTHER_TWIN)])
    leads.to_csv(RESULTS / "sim_to_real_ahead.csv", index=False, float_format="%.4g")
    print(leads.to_string(index=False, float_format=lambda x: f"{x:.2f}"))
    figure(shown)
    figure_of_gap(shown)


def by_cell(table: pd.DataFrame, shown: pd.DataFrame) -> pd.DataFrame:
    """
    A row for each cell: its gap, the share of it that HDS closes, and by how much HDS is ahead of
    the best model-free learner at the same number of real steps (the least over those numbers, over
    seeds that both have).
    """
    rows = {}
    for cell, group in shown.groupby("cell", sort=False):
        share = group.set_index(["method", "episodes"])["closed"]
        first = group.iloc[0]
        row = {name: first[name] for name in ("gap", "gap_stderr", "counts", "seeds")}
        for method, episodes in [("randomised", 0), *(("hds", n) for n in STEPS)]:
            name = f"hds_after_{episodes}" if episodes else method
            row[name] = share.get((method, episodes), np.nan)
        row["hds_ahead_by"] = ahead(table[table["cell"] == cell])
        rows[cell] = row
    return pd.DataFrame(rows).T


def ahead(group: pd.DataFrame) -> float:
    """The least lead of HDS over all learners and numbers of steps, over common seeds."""
    returns = group.pivot_table("return", ["seed", "episodes"], "method")
    others = [name for name in ("sac", "tqc", "droq") if name in returns]
    if "hds" not in returns or not others:
        return np.nan
    differences = returns[others].rsub(returns["hds"], axis=0).groupby("episodes").mean()
    return float(differences.min(axis=None))


def seed_by_seed(table: pd.DataFrame) -> pd.DataFrame:
    """How often HDS is behind a learner with the same seed after the same number of real steps."""
    returns = table.pivot_table("return", ["cell", "seed", "episodes"], "method")
    rows = []
    for method in ("sac", "tqc", "droq"):
        if "hds" in returns and method in returns:
            leads = (returns["hds"] - returns[method]).dropna()
            behind = int((leads <= 0.0).sum())
            rows.append((method, len(leads), behind, leads.min()))
    return pd.DataFrame(rows, columns=["learner", "comparisons", "HDS behind", "least lead"])


def over_cells(table: pd.DataFrame, cells: list[str], n_draws: int = 2000) -> pd.DataFrame:
    """
    The median over cells of the share of the gap that is closed, with its interval. Of a table
    that is not finished, over the cells that have run.

    :param cells: that count
    """
    rng, rows = np.random.default_rng(0), []
    returns_of = {
        cell: table[table["cell"] == cell].pivot_table("return", "seed", ["method", "episodes"])
        for cell in cells
    }
    for method, episodes in [("randomised", 0), *(("hds", n) for n in STEPS)]:
        drawn = []
        for returns in returns_of.values():
            if (method, episodes) not in returns:
                continue
            wrong, best = returns["wrong_twin", 0], returns["ceiling", 0]
            pairs = pd.concat([returns[method, episodes] - wrong, best - wrong], axis=1).dropna()
            if pairs.empty:
                continue
            gained, gaps = pairs.to_numpy().T
            index = rng.integers(len(pairs), size=(n_draws, len(pairs)))
            index[0] = np.arange(len(pairs))
            drawn.append(gained[index].mean(1) / gaps[index].mean(1))
        if not drawn:
            continue
        medians = np.median(drawn, axis=0)
        low, high = np.quantile(medians, (0.05, 0.95))
        rows.append((method, episodes, medians[0], low, high, len(drawn)))
    return pd.DataFrame(rows, columns=["method", "episodes", "closed", "low", "high", "cells"])


def closed(table: pd.DataFrame) -> pd.DataFrame:
    """The share of each cell's gap that a method closes, over the seeds that it was run with."""
    rows = []
    for cell, group in table.groupby("cell", sort=False):
        by_seed = group.pivot_table("return", "seed", ["method", "episodes"])
        if ("ceiling", 0) not in by_seed or ("wrong_twin", 0) not in by_seed:
            continue
        gaps = (by_seed["ceiling", 0] - by_seed["wrong_twin", 0]).dropna()
        stderr = gaps.std(ddof=1) / np.sqrt(len(gaps)) if len(gaps) > 1 else np.nan
        for method, episodes in by_seed.columns:
            values = by_seed[method, episodes].dropna()
            paired = values.index.intersection(gaps.index)
            gained = (values - by_seed["wrong_twin", 0])[paired]
            gap = gaps[paired].mean()
            share = gained.mean() / gap if gap else np.nan
            rows.append(
                {
                    "cell": cell,
                    "method": method,
                    "episodes": episodes,
                    "return": values.mean(),
                    "closed": share,
                    "gap": gaps.mean(),
                    "gap_stderr": stderr,
                    "counts": bool(gaps.mean() > 3.0 * stderr),
                    "seeds": len(values),
                }
            )
    return pd.DataFrame(rows)


def learned_in(shown: pd.DataFrame) -> list[str]:
    """:return: cells in which a learner was run, in order"""
    return list(dict.fromkeys(shown[shown["episodes"] > 0]["cell"]))


def figure(shown: pd.DataFrame) -> None:
    """Return against real episodes, a panel for each cell."""
    from matplotlib.figure import Figure

    cells = learned_in(shown)
    columns = min(4, len(cells))
    lines = -(-len(cells) // columns)
    drawing = Figure(figsize=(3.2 * columns, 2.6 * lines), layout="constrained")
    panels = drawing.subplots(lines, columns, squeeze=False).ravel()
    styles = {
        "hds": "#27496d",
        "sac": "#d1495b",
        "tqc": "#edae49",
        "droq": "#66a182",
    }
    for panel, cell in zip(panels, cells, strict=False):
        group = shown[shown["cell"] == cell]
        for method, style in (("ceiling", "-"), ("randomised", ":"), ("wrong_twin", "--")):
            for value in group[group["method"] == method]["return"]:
                panel.axhline(value, color="#9a978c", linestyle=style, label=method)
        for method, colour in styles.items():
            rows = group[group["method"] == method]
            panel.plot(rows["episodes"], rows["return"], "o-", color=colour, label=method)
        # The returns of a learner that first spins would compress the rest to a line.
        worst, best = group["return"].min(), group["return"].max()
        deepest = max(worst, best - _DEEPEST)
        panel.set_ylim(deepest - 0.05 * (best - deepest), best + 0.1 * (best - deepest))
        panel.set_title(cell, fontsize=9)
        panel.set_xlabel("real episodes", fontsize=8)
        panel.tick_params(labelsize=8)
    for panel in panels[len(cells) :]:
        panel.set_visible(False)
    panels[0].set_ylabel("return on the real system", fontsize=8)
    named = {
        label: handle
        for panel in panels
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)
    }
    drawing.legend(
        named.values(),
        [label.replace("_", " ") for label in named],
        loc="outside upper center",
        ncols=len(named),
        fontsize=8,
        frameon=False,
    )
    drawing.savefig(RESULTS / "sim_to_real.png", dpi=150)


def figure_of_gap(shown: pd.DataFrame) -> None:
    """The share of each cell's gap that is closed, with what counts on top."""
    from matplotlib.figure import Figure

    own = shown[shown["cell"].isin(learned_in(shown)) & ~shown["cell"].isin(OTHER_TWIN)]
    cells = list(dict.fromkeys(own.sort_values("counts", ascending=False, kind="stable")["cell"]))
    counts = own.groupby("cell")["counts"].first()
    drawing = Figure(figsize=(6.4, 0.34 * len(cells) + 1.2), layout="constrained")
    panel = drawing.subplots()
    panel.axvline(0.0, color="#9a978c", linestyle="--", linewidth=1)
    panel.axvline(1.0, color="#9a978c", linewidth=1)
    styles = {
        ("randomised", 0): ("domain randomisation, no data", "#edae49", "D"),
        ("hds", 1): ("HDS, 1 episode", "#a9bdd3", "o"),
        ("hds", 5): ("HDS, 5 episodes", "#5d82a8", "o"),
        ("hds", 10): ("HDS, 10 episodes", "#27496d", "o"),
    }
    for (method, episodes), (label, colour, marker) in styles.items():
        rows = own[(own["method"] == method) & (own["episodes"] == episodes)]
        share = rows.set_index("cell")["closed"].reindex(cells)
        height = [-cells.index(cell) for cell in share.index]
        inside = share.clip(_LEAST_SHOWN, _MOST_SHOWN)
        panel.plot(inside, height, marker, color=colour, label=label, markersize=6)
        for x, y, value in zip(inside, height, share, strict=True):
            if x != value and np.isfinite(value):
                side = 1 if value < x else -1
                panel.annotate(
                    f"{value:.1f}", (x, y), (7 * side, 0), textcoords="offset points",
                    ha="left" if side > 0 else "right", va="center", fontsize=7, color=colour,
                )  # fmt: skip
    panel.set_yticks(
        range(0, -len(cells), -1),
        [cell if counts[cell] else f"{cell} (not counted)" for cell in cells],
    )
    panel.set_xlim(_LEAST_SHOWN - 0.05, _MOST_SHOWN + 0.05)
    panel.set_xlabel("share of the gap that is closed", fontsize=8)
    panel.grid(axis="x", color="#e4e2da", linewidth=0.6)
    panel.spines[["top", "right", "left"]].set_visible(False)
    panel.tick_params(length=0, labelsize=8)
    drawing.legend(loc="outside upper center", ncols=2, fontsize=8, frameon=False)
    drawing.savefig(RESULTS / "sim_to_real_gap.png", dpi=150)


if __name__ == "__main__":
    main()
