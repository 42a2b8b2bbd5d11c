"""Pictures of results; matplotlib is imported only here, and only when one is drawn."""

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from sb3_hds.sysid.results import Fit

_BEFORE, _AFTER, _NOISE = "#d1495b", "#27496d", "#9a978c"


def plot_fit(fit: "Fit", path: Any) -> None:
    """Estimates with intervals on the left, errors of each channel on the right."""
    from matplotlib.figure import Figure

    n = max(len(fit.estimates), len(fit.channels))
    figure = Figure(figsize=(9.0, 1.6 + 0.45 * n), layout="constrained")
    left, right = figure.subplots(1, 2)
    _draw_estimates(left, fit)
    _draw_errors(right, fit)
    figure.savefig(path, dpi=150)


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
    axes.barh(rows - 0.2, fit.error_before / fit.noise, 0.35, color=_BEFORE, label="before")
    axes.barh(rows + 0.2, fit.error_after / fit.noise, 0.35, color=_AFTER, label="after")
    axes.axvline(1.0, color=_NOISE, linewidth=1.0, label="noise")
    axes.set_xscale("log")
    axes.set_yticks(rows, [name for name, _ in fit.channels])
    axes.invert_yaxis()
    axes.set_xlabel("error over a window, in units of the noise")
    axes.set_title("prediction error", fontsize=10)
    axes.legend(fontsize=8, frameon=False)
