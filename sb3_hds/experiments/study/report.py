"""The report of a study: an HTML page and its figures."""

import base64
import io
import itertools
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float

from sb3_hds.core.trajectories.storage import write_bytes
from sb3_hds.errors import StudyError
from sb3_hds.experiments.study.definition import Run, Study
from sb3_hds.experiments.study.runner import CLOCK, MARK, is_complete

_REPS = 2_000
_LEVEL = 0.95
# Number of points of a curve.
_N_POINTS = 100

Scores = Float[np.ndarray, "seed env"]


class Reported(NamedTuple):
    """
    A written report.

    :param page: self-contained HTML
    :param figures: PNG and PDF files beside it
    :param n_runs: number of reported runs
    """

    page: Path
    figures: tuple[Path, ...]
    n_runs: int


def results_of(study: Study, folder: str | os.PathLike[str]) -> pd.DataFrame:
    """
    :param folder: of its runs
    :return: one row per evaluation of each complete run: ``label``, ``env``, ``seed``,
        ``timesteps``, ``seconds`` since the training began, evaluations included, and ``return``,
        the mean over episodes
    :raises StudyError: if no run is complete
    """
    root, rows = Path(folder), []
    for run in study.runs:
        if not is_complete(study, run, root):
            continue
        with np.load(root / run.place / "evaluations.npz") as held:
            steps, returns = held["timesteps"], held["results"].mean(axis=1)
        clock = pd.read_csv(root / run.place / CLOCK)
        seconds = np.interp(steps, clock["timesteps"], clock["seconds"])
        rows += [
            {
                "label": run.label,
                "env": run.env,
                "seed": run.seed,
                "timesteps": int(step),
                "seconds": float(second),
                "return": float(value),
            }
            for step, second, value in zip(steps, seconds, returns, strict=True)
        ]
    if not rows:
        raise StudyError(f"No run of '{study.name}' is complete in '{folder}': study run first.")
    return pd.DataFrame(rows)


def write_report(
    study: Study, folder: str | os.PathLike[str], page: str | os.PathLike[str]
) -> Reported:
    """
    Write curves against steps and wall time, and if several algorithms have the same seeds and
    environments, IQM, performance profiles and probabilities of improvement (Agarwal et al.,
    *Deep Reinforcement Learning at the Edge of the Statistical Precipice*, NeurIPS 2021, by their
    library rliable), with bootstrap intervals over seeds.

    :param page: HTML file to write, with figures beside it
    :raises StudyError: if no run is complete
    :raises ImportError: without the extras ``report`` and ``zoo``
    """
    table, root, target = results_of(study, folder), Path(folder), Path(page)
    target.parent.mkdir(parents=True, exist_ok=True)
    drawn = {"curves": _curves(table)}
    scores = normalized_scores(table)
    if len(scores) > 1:
        drawn |= _comparisons(scores)
    figures, images = [], {}
    for name, figure in drawn.items():
        for kind in ("png", "pdf"):
            content = io.BytesIO()
            figure.savefig(content, format=kind, dpi=130, bbox_inches="tight")
            path = target.with_name(f"{target.stem}_{name}.{kind}")
            figures.append(write_bytes(path, content.getvalue()))
            if kind == "png":
                images[name] = base64.b64encode(content.getvalue()).decode()
    text = _page(study, root, table, images)
    write_bytes(target, text.encode())
    n_runs = len(table.groupby(["label", "env", "seed"]))
    return Reported(target, tuple(figures), n_runs)


def final_returns(table: pd.DataFrame) -> pd.DataFrame:
    """:return: the last evaluation of each run"""
    ordered = table.sort_values("timesteps")
    return ordered.groupby(["label", "env", "seed"], as_index=False).last()


def normalized_scores(table: pd.DataFrame) -> dict[str, Scores]:
    """
    Normalise final returns per environment: 0 is the lowest evaluation of any run, 1 the highest
    final return.

    :return: by label, for algorithms that have all environments with the same seeds
    """
    last = final_returns(table)
    scores = np.zeros(len(last))
    for env in last["env"].unique():
        here = last["env"] == env
        low, high = table["return"][table["env"] == env].min(), last["return"][here].max()
        scores[here] = (last["return"][here] - low) / ((high - low) or 1.0)
    last["score"] = scores
    grids = {
        str(label): part.pivot(index="seed", columns="env", values="score")
        for label, part in last.groupby("label")
    }
    widest = max((grid.shape for grid in grids.values()), key=lambda shape: shape[0] * shape[1])
    return {
        label: grid.to_numpy()
        for label, grid in grids.items()
        if grid.shape == widest and not grid.isna().to_numpy().any() and widest[0] > 1
    }


def _interval(
    curves: Float[np.ndarray, "seed point"], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean over seeds, and the ends of its percentile bootstrap interval."""
    drawn = rng.integers(0, len(curves), (_REPS, len(curves)))
    means = curves[drawn].mean(axis=1)
    tails = 50.0 * (1.0 - _LEVEL), 100.0 - 50.0 * (1.0 - _LEVEL)
    low, high = np.percentile(means, tails, axis=0)
    return curves.mean(axis=0), low, high


def _curves(table: pd.DataFrame) -> Any:
    """One row per environment: returns against steps, and against wall time."""
    from matplotlib.figure import Figure

    envs = list(dict.fromkeys(table["env"]))
    figure = Figure(figsize=(10.0, 3.2 * len(envs)), layout="constrained")
    axes = figure.subplots(len(envs), 2, squeeze=False, sharey="row")
    rng = np.random.default_rng(0)
    for row, env in enumerate(envs):
        for column, along in enumerate(("timesteps", "seconds")):
            axis, here = axes[row, column], table[table["env"] == env]
            for label, part in here.groupby("label"):
                runs = [run for _, run in part.groupby("seed")]
                end = min(run[along].max() for run in runs)
                begin = max(run[along].min() for run in runs)
                points = np.linspace(min(begin, end), end, _N_POINTS)
                curves = np.array([np.interp(points, run[along], run["return"]) for run in runs])
                mean, low, high = _interval(curves, rng)
                (line,) = axis.plot(points, mean, label=f"{label} ({len(runs)} seeds)")
                axis.fill_between(points, low, high, alpha=0.2, color=line.get_color())
            axis.set_xlabel("steps" if along == "timesteps" else "wall time [s]")
            axis.set_title(env)
        axes[row, 0].set_ylabel("return")
        axes[row, 0].legend(fontsize="small")
    return figure


def _comparisons(scores: dict[str, Scores]) -> dict[str, Any]:
    from matplotlib.figure import Figure
    from rliable import library, metrics

    def estimates(given: Any, function: Callable[..., Any]) -> Any:
        return library.get_interval_estimates(
            given, function, reps=_REPS, confidence_interval_size=_LEVEL
        )

    iqm, ends = estimates(scores, lambda x: np.array([metrics.aggregate_iqm(x)]))
    aggregate = Figure(figsize=(6.0, 0.8 + 0.4 * len(scores)), layout="constrained")
    _bars(aggregate.subplots(), list(scores), iqm, ends, "IQM of normalised final returns")
    taus = np.linspace(0.0, 1.0, 51)
    profiles, bands = library.create_performance_profile(scores, taus, reps=_REPS)
    profile = Figure(figsize=(6.0, 3.6), layout="constrained")
    axis = profile.subplots()
    for label in scores:
        (line,) = axis.plot(taus, profiles[label], label=label)
        axis.fill_between(taus, *bands[label], alpha=0.2, color=line.get_color())
    axis.set_xlabel("normalised final return")
    axis.set_ylabel("share of runs above it")
    axis.legend(fontsize="small")
    pairs = {f"{a} > {b}": (scores[a], scores[b]) for a, b in itertools.permutations(scores, 2)}
    better, ends = estimates(pairs, metrics.probability_of_improvement)
    versus = Figure(figsize=(6.0, 0.8 + 0.4 * len(pairs)), layout="constrained")
    axis = versus.subplots()
    _bars(axis, list(pairs), better, ends, "probability of improvement")
    axis.axvline(0.5, color="0.5", linewidth=0.8)
    return {"iqm": aggregate, "profiles": profile, "improvement": versus}


def _bars(axis: Any, names: Sequence[str], values: Any, ends: Any, title: str) -> None:
    for place, name in enumerate(names):
        low, high = (float(np.ravel(end)[0]) for end in ends[name])
        axis.barh(place, high - low, left=low, height=0.5, alpha=0.4)
        axis.plot([float(np.ravel(values[name])[0])] * 2, [place - 0.25, place + 0.25], color="k")
    axis.set_yticks(range(len(names)), names)
    axis.set_xlabel(title)


def _page(study: Study, root: Path, table: pd.DataFrame, images: dict[str, str]) -> str:
    from jinja2 import Environment, FileSystemLoader

    runs = [run for run in study.runs if is_complete(study, run, root)]
    marks = [json.loads((root / run.place / MARK).read_text()) for run in runs]
    pages = Environment(loader=FileSystemLoader(Path(__file__).parent), autoescape=True)
    return pages.get_template("report.html").render(
        study=study,
        n_runs=len(runs),
        rows=_rows(table),
        images=images,
        hyperparams=_hyperparams(runs, root),
        versions=marks[0]["versions"],
        machines={json.dumps(mark["machine"], sort_keys=True) for mark in marks},
        commands=[" ".join(map(str, mark["command"])) for mark in marks],
        level=round(100 * _LEVEL),
    )


def _rows(table: pd.DataFrame) -> list[dict[str, Any]]:
    rng, rows = np.random.default_rng(0), []
    for (env, label), part in final_returns(table).groupby(["env", "label"]):  # type: ignore[misc]
        mean, low, high = _interval(part["return"].to_numpy()[:, None], rng)
        rows.append(
            {
                "env": env,
                "label": label,
                "seeds": len(part),
                "mean": f"{mean[0]:.1f}",
                "interval": f"{low[0]:.1f} to {high[0]:.1f}",
                "steps": f"{part['timesteps'].mean():,.0f}",
                "seconds": f"{part['seconds'].mean():,.0f}",
            }
        )
    return rows


def _hyperparams(runs: Sequence[Run], root: Path) -> dict[str, str]:
    """The zoo's file from the first run of each algorithm in each environment."""
    found: dict[str, str] = {}
    for run in runs:
        file = root / run.place / run.env_name / "config.yml"
        key = f"{run.label} on {run.env}"
        if key not in found and file.exists():
            found[key] = file.read_text()
    return found
