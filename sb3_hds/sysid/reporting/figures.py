"""Figures of results; matplotlib is imported only when one is drawn."""

import io
import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_hds.core import Trajectories
from sb3_hds.core.belief import BeliefTwin
from sb3_hds.sysid.reporting.wording import TRAINED_IN, share_in_words

if TYPE_CHECKING:
    from sb3_hds.sysid.estimation.results import Fit
    from sb3_hds.sysid.reporting.pictures import Pictures

_MEASURED, _BEFORE, _AFTER, _ALIKE, _QUIET = "#3b3a36", "#d1495b", "#27496d", "#8fabc9", "#9a978c"
# One for each answer that the data leave open.
_OF_ANSWERS = (_AFTER, _BEFORE, "#8a6d1d", "#2e7d6b", "#7a4f9a", _QUIET)
# Widths for a desktop or paper, and for a phone [in]; the font size is the same.
_WIDE, _NARROW = 9.0, 4.4
_DPI = 150
# Gains below this are drawn as this.
_WORST = -0.05
# Margin of a panel around the measurements where the nominal model diverges, in shares of their
# range; ratio of errors from which they are drawn on a logarithmic scale.
_AROUND, _DECADE = 0.5, 10.0
# Characters per line of a label.
_LINE = 16


def as_png(figure: Any) -> bytes:
    """:return: the picture, as a file would hold it"""
    data = io.BytesIO()
    figure.savefig(data, dpi=_DPI, format="png")
    return data.getvalue()


def plot_fit(fit: "Fit", path: Any) -> None:
    """Estimates with intervals on the left, errors of each channel on the right."""
    n = max(len(fit.estimates), len(fit.channels))
    figure = _empty_figure((_WIDE, 1.6 + 0.45 * n))
    left, right = figure.subplots(1, 2)
    _draw_estimates(left, fit)
    _draw_errors(right, fit)
    figure.savefig(path, dpi=_DPI)


def plot_rollouts(p: "Pictures", narrow: bool = False) -> Any:
    """Each channel as measured and simulated, and beside it the errors of the simulations."""
    figure, panels = _figure(len(p.channels), 2, 1.6, narrow)
    seen = p.replay
    for j, (name, unit) in enumerate(p.channels):
        left, right = panels[j]
        left.plot(seen.time, seen.measured[:, j], ".", color=_MEASURED, ms=3, label="measured")
        simulated = (seen.before, _BEFORE, "before"), (seen.after, _AFTER, "after")
        for values, colour, label in simulated:
            left.plot(seen.time, values[:, j], color=colour, lw=1.2, label=label)
            missed = values[:, j] - seen.measured[:, j]
            right.plot(seen.time, missed, color=colour, lw=1.2, label=label)
        for axes, centre in ((left, seen.after), (right, seen.after - seen.measured)):
            ends = [centre[:, j] + side * seen.margin[:, j] for side in (-1.0, 1.0)]
            axes.fill_between(seen.time, *ends, color=_AFTER, alpha=0.15, lw=0.0)
        right.axhline(0.0, color=_MEASURED, lw=0.6)
        measured, after = seen.measured[:, j], seen.after[:, j]
        around = _AROUND * np.ptp(measured[np.isfinite(measured)])
        _cut(left, np.concatenate([measured, after]), around)
        _cut(right, np.append(after - measured, 0.0), around)
        for axes in panels[j, : 2 if narrow else 1]:
            axes.set_ylabel(_label(name, unit), fontsize=8)
        if j == 0 or narrow:
            left.set_title("simulated and measured", fontsize=9)
            right.set_title("simulated minus measured", fontsize=9)
    _legend_above(figure, panels[0, 0], 3)
    for axes in panels[-1]:
        axes.set_xlabel("time [s]", fontsize=8)
    return figure


def plot_horizons(d: Any, p: "Pictures", narrow: bool = False) -> Any:
    """Prediction error against the horizon."""
    figure, panels = _figure(1, 1, 2.6, narrow)
    axes = panels[0, 0]
    for errors, colour, label in zip(p.errors, (_BEFORE, _AFTER), ("before", "after"), strict=True):
        axes.plot(p.steps, errors, "o-", color=colour, ms=3, label=label)
    for gain in d.gain.values():
        ends = [gain.before * np.sqrt(max(1.0 - end, 0.0)) for end in (gain.low, gain.high)]
        axes.plot([gain.steps] * 2, ends, color=_AFTER, lw=4.0, alpha=0.3)
    axes.axhline(1.0, color=_QUIET, lw=1.0, ls="--", label="what the best fit leaves")
    if np.nanmax(p.errors[0]) > _DECADE * np.nanmax(p.errors[1]):
        axes.set_yscale("log")
    else:
        axes.set_ylim(bottom=0.0)
    axes.set_xlabel("steps from the start of a window", fontsize=8)
    axes.set_ylabel("error / what the best fit leaves", fontsize=8)
    axes.legend(fontsize=8, frameon=False)
    return figure


def plot_missing_force(p: "Pictures", narrow: bool = False) -> Any:
    """The residual force of each joint against position, velocity, command and time."""
    columns = 4 if p.actuators else 3
    figure, panels = _figure(len(p.joints), columns, 2.2, narrow)
    explained = p.missing.force - p.left.force
    for j, (name, unit) in enumerate(p.joints):
        joint_unit = "m" if unit == "N" else "rad"
        against: list[tuple[str, np.ndarray]] = [
            (f"position [{joint_unit}]", p.missing.position[:, j]),
            (f"velocity [{joint_unit}/s]", p.missing.velocity[:, j]),
            ("time [s]", p.missing.time),
        ]
        if p.actuators:
            command = min(j, len(p.actuators) - 1)
            label = f"command [{p.actuators[command][1]}]"
            against.insert(2, (label, p.missing.command[:, command]))
        low, high = np.quantile(p.missing.force[:, j], [0.01, 0.99])
        margin = 0.2 * (high - low) + 1e-12
        for k, (axes, (label, values)) in enumerate(zip(panels[j], against, strict=True)):
            axes.plot(values, p.missing.force[:, j], ".", color=_QUIET, ms=3)
            if np.any(explained[:, j]):
                axes.plot(values, explained[:, j], ".", color=_AFTER, ms=3)
            axes.axhline(0.0, color=_MEASURED, lw=0.6)
            axes.set_ylim(low - margin, high + margin)
            axes.set_xlabel(label, fontsize=8)
            if k == 0 or narrow:
                axes.set_ylabel(_label(name, unit), fontsize=8)
    return figure


def plot_friction(p: "Pictures", narrow: bool = False) -> Any:
    """Resistance against velocity, of each joint at which friction was found."""
    columns = min(3, len(p.friction))
    rows = -(-len(p.friction) // columns)
    figure, panels = _figure(rows, columns, 2.4, narrow)
    for axes, curve in zip(panels.ravel(), p.friction, strict=False):
        name, unit = p.joints[curve.joint]
        axes.plot(curve.velocity, curve.measured, ".", color=_MEASURED, ms=5, label="measured")
        axes.plot(curve.velocity, curve.found, color=_AFTER, lw=1.5, label="found")
        axes.axhline(0.0, color=_MEASURED, lw=0.6)
        axes.set_title(name, fontsize=9)
        axes.set_xlabel(f"velocity [{'m' if unit == 'N' else 'rad'}/s]", fontsize=8)
        axes.set_ylabel(f"friction [{unit}]", fontsize=8)
    for axes in panels.ravel()[len(p.friction) :]:
        axes.remove()
    _legend_above(figure, panels[0, 0], 2)
    return figure


def plot_evidence(d: Any, narrow: bool = False) -> Any:
    """A bar for every candidate, those that were named first."""
    from matplotlib.patches import Patch

    alike = {name for finding in d.findings for name in finding.alternatives}
    bars = [(f.key, f.gain, _AFTER) for f in d.findings]
    bars += [(r.name, r.gain, _ALIKE if r.name in alike else _QUIET) for r in d.rejected]
    figure, panels = _figure(1, 1, 0.4 + 0.18 * len(bars), narrow)
    axes, rows = panels[0, 0], np.arange(len(bars))
    axes.barh(rows, [max(gain, _WORST) for _, gain, _ in bars], color=[c for *_, c in bars])
    axes.axvline(0.05, color=_BEFORE, lw=1.0, ls="--", zorder=0.5)
    axes.axvline(0.0, color=_MEASURED, lw=0.6)
    for row, (_, gain, _) in enumerate(bars):
        axes.annotate(
            share_in_words(gain),
            (max(gain, 0.0), row),
            (3, 0),
            textcoords="offset points",
            va="center",
            size=7,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.4},
        )
    axes.set_yticks(rows, [name for name, *_ in bars], fontsize=7)
    axes.tick_params(axis="y", length=0)
    axes.set_ylim(len(bars) - 0.4, -0.6)
    axes.set_xlim(_WORST - 0.01, 1.08)
    axes.set_xlabel("gain on held-out recordings", fontsize=8)
    kinds = {_AFTER: "named", _ALIKE: "cannot be told from it", _QUIET: "not accepted"}
    drawn = [colour for colour in kinds if any(colour == c for *_, c in bars)]
    if len(drawn) > 1:
        handles = [Patch(color=colour, label=kinds[colour]) for colour in drawn]
        figure.legend(
            handles=handles, fontsize=7, frameon=False, ncols=3, loc="outside upper center"
        )
    return figure


def plot_policy_gain(gain: Mapping[str, Any], narrow: bool = False) -> Any:
    """
    A dot for each run, a line at the interquartile mean, a bar over its interval; of a single run,
    a dot for each start state, and no interval.

    :param gain: ``PolicyGain.to_dict()``
    """
    colours = {"believed": _BEFORE, "extended": _AFTER, "true": _QUIET}
    names = list(gain["simulations"])
    figure, panels = _figure(1, 1, 0.5 + 0.6 * len(names), narrow)
    axes = panels[0, 0]
    for row, name in enumerate(names):
        found, returns = gain["simulations"][name], np.asarray(gain["returns"][name])
        dots = np.mean(returns, 1) if len(returns) > 1 else returns[0]
        apart = row + np.linspace(-0.15, 0.15, len(dots) + 2)[1:-1]
        if len(returns) > 1:
            ends = [found["low"], found["high"]]
            axes.plot(ends, [row] * 2, color=colours[name], lw=8, alpha=0.3)
        axes.plot([found["mean"]] * 2, [row - 0.25, row + 0.25], color=colours[name], lw=2)
        axes.plot(dots, apart, "o", color=colours[name], ms=4, alpha=0.6)
    axes.set_yticks(range(len(names)), [TRAINED_IN[name] for name in names])
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.margins(x=0.1)
    axes.set_xlabel("return on the real system", fontsize=8)
    return figure


def plot_belief(belief: BeliefTwin, path: str | os.PathLike[str]) -> None:
    """
    Draw each uncertain parameter: its draws, by answer, and the value of the likeliest answer.

    :param path: of the picture, for example ``"belief.png"``
    """
    rows = max(len(belief.varied), 1)
    figure = _empty_figure((_WIDE, 0.9 + 0.8 * rows))
    panels = figure.subplots(rows, 1, squeeze=False)[:, 0]
    names = list(belief.base.parameters)
    height = np.random.default_rng(0).uniform(-0.35, 0.35, len(belief.draws))
    for axes, name in zip(panels, belief.varied, strict=False):
        values = belief.draws[:, names.index(name)]
        for m, answer in enumerate(belief.answers):
            own, colour = belief.origin == m, _OF_ANSWERS[m % len(_OF_ANSWERS)]
            label = f"{answer} ({belief.weights[m]:.0%})"
            axes.plot(values[own], height[own], ".", color=colour, ms=4, label=label)
        axes.axvline(values[0], color=_MEASURED, lw=1.0)
        axes.set(yticks=[], ylim=(-0.5, 0.5))
        axes.set_xlabel(_with_unit(name, belief.base.parameters[name].unit), fontsize=8)
    _legend_above(figure, panels[0], 2)
    figure.savefig(path, dpi=_DPI)


def plot_next(
    commands: Trajectories,
    predicted: np.ndarray,
    answers: Sequence[str],
    channels: Sequence[tuple[str, str]],
    actuators: Sequence[tuple[str, str]],
    narrow: bool = False,
) -> Any:
    """
    The commands of the first recording, and below them each channel as each answer predicts it.

    :param predicted: shape ``(answers, recordings, steps + 1, n_obs)``
    :param channels: name and unit of each
    :param actuators: name and unit of each
    """
    rows = len(actuators) + len(channels)
    figure = _empty_figure((_NARROW if narrow else _WIDE, 0.8 + 1.3 * rows))
    panels = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
    time = commands.dt * np.arange(predicted.shape[2])
    for j, axes in enumerate(panels[: len(actuators)]):
        axes.step(time[:-1], commands.actions[0, :, j], where="post", color=_MEASURED, lw=1.2)
    for j, axes in enumerate(panels[len(actuators) :]):
        for i, answer in enumerate(answers):
            colour = _OF_ANSWERS[i % len(_OF_ANSWERS)]
            axes.plot(time, predicted[i, 0, :, j], color=colour, lw=1.2, label=answer)
    for axes, (name, unit) in zip(panels, [*actuators, *channels], strict=True):
        axes.set_ylabel(_with_unit(name, unit), fontsize=8)
    _legend_above(figure, panels[-1], 1 if narrow else 3)
    panels[-1].set_xlabel("time [s]", fontsize=8)
    return figure


def _legend_above(figure: Any, axes: Any, columns: int) -> None:
    entries = axes.get_legend_handles_labels()
    figure.legend(*entries, fontsize=8, frameon=False, ncols=columns, loc="outside upper center")


def _with_unit(name: str, unit: str) -> str:
    return name if unit in ("", "1") else f"{name} [{unit}]"


def _empty_figure(size: tuple[float, float]) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=size, layout="constrained")


def _cut(axes: Any, shown: np.ndarray, around: float) -> None:
    """Limit a panel to the data shown, with a margin."""
    shown = shown[np.isfinite(shown)]
    ends, whole = (shown.min() - around, shown.max() + around), axes.get_ylim()
    if around > 0.0:
        axes.set_ylim(max(ends[0], whole[0]), min(ends[1], whole[1]))


def _label(name: str, unit: str) -> str:
    """Name and unit, with line breaks between words."""
    lines = [""]
    for word in name.replace("_", "_ ").split():
        if lines[-1] and len(lines[-1] + word) > _LINE:
            lines.append("")
        lines[-1] += word
    last = lines[-1] if len(lines[-1]) + len(unit) < _LINE else f"{lines[-1]}\n"
    return "\n".join([*lines[:-1], f"{last} [{unit}]".replace("\n ", "\n")])


def _figure(rows: int, columns: int, height: float, narrow: bool) -> tuple[Any, np.ndarray]:
    """
    :param height: of a row [in]
    :param narrow: whether to place the panels of a row two abreast, or one below the other
    :return: figure, and its panels in ``rows`` and ``columns``, wherever they are placed
    """
    beside = columns if not narrow else 2 if columns == 4 else 1
    deep = rows * columns // beside
    figure = _empty_figure((_NARROW if narrow else _WIDE, 0.5 + height * deep))
    panels = figure.subplots(deep, beside, squeeze=False).reshape(rows, columns)
    for axes in panels.ravel():
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
    return figure, panels


def _draw_estimates(axes: Any, fit: "Fit") -> None:
    """Deviations from the values before, in units of each parameter's typical deviation."""
    names = [estimate.name for estimate in fit.estimates]
    for row, estimate in enumerate(fit.estimates):
        scale = fit.twin.parameters[estimate.name].scale
        at = (estimate.estimate - estimate.before) / scale
        ends = [(end - estimate.before) / scale for end in (estimate.low, estimate.high)]
        if np.isfinite(ends).all():
            axes.plot(ends, [row, row], color=_AFTER, linewidth=2.0)
        axes.plot(at, row, "o", color=_AFTER)
        text = f"{estimate.estimate:.4g} {estimate.unit}"
        axes.annotate(text, (at, row), (0, 6), textcoords="offset points", ha="center", fontsize=8)
    axes.axvline(0.0, color=_BEFORE, linewidth=1.0)
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.margins(x=0.2)
    axes.set_xlabel("change from the value before, in typical deviations")
    axes.set_title(f"estimates and {100.0 * fit.level:g} % intervals", fontsize=10)


def _draw_errors(axes: Any, fit: "Fit") -> None:
    rows = np.arange(len(fit.channels))
    known = np.isfinite(fit.error_before)
    if known.any():
        before = (fit.error_before / fit.noise)[known]
        axes.barh(rows[known] - 0.2, before, 0.35, color=_BEFORE, label="before")
    axes.barh(rows + 0.2, fit.error_after / fit.noise, 0.35, color=_AFTER, label="after")
    axes.axvline(1.0, color=_QUIET, linewidth=1.0, label="noise")
    axes.set_xscale("log")
    axes.set_yticks(rows, [name for name, _ in fit.channels])
    axes.invert_yaxis()
    axes.set_xlabel("error / noise")
    diverged = "" if known.all() else "\n(before: the simulation diverges)"
    axes.set_title(f"prediction error over a window{diverged}", fontsize=10)
    axes.legend(fontsize=8, frameon=False, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.06))
