"""A picture of a belief; matplotlib is imported only when one is drawn."""

import os
from typing import Any

import numpy as np

from sb3_hds.core.belief import BeliefTwin

_COLOURS = ("#27496d", "#d1495b", "#8a6d1d", "#2e7d6b", "#7a4f9a", "#9a978c")
_BEST = "#3b3a36"


def plot_belief(belief: BeliefTwin, path: str | os.PathLike[str]) -> None:
    """
    Draw what differs between draws: of each parameter the draws, by answer, and the best guess.

    :param path: of the picture, for example ``"belief.png"``
    """
    from matplotlib.figure import Figure

    n = max(len(belief.varied), 1)
    figure = Figure(figsize=(9.0, 0.9 + 0.8 * n), layout="constrained")
    panels = figure.subplots(n, 1, squeeze=False)[:, 0]
    names, rows = list(belief.base.parameters), belief.draws
    height = np.random.default_rng(0).uniform(-0.35, 0.35, len(rows))
    for axes, name in zip(panels, belief.varied, strict=False):
        values = rows[:, names.index(name)]
        for m, answer in enumerate(belief.answers):
            own = belief.origin == m
            label = f"{answer} ({belief.weights[m]:.0%})"
            axes.plot(values[own], height[own], ".", color=_colour(m), ms=4, label=label)
        axes.axvline(values[0], color=_BEST, lw=1.0)
        axes.set(yticks=[], ylim=(-0.5, 0.5))
        unit = belief.base.parameters[name].unit
        axes.set_xlabel(name if unit == "1" else f"{name} [{unit}]", fontsize=8)
    figure.legend(
        *panels[0].get_legend_handles_labels(),
        fontsize=8,
        frameon=False,
        ncols=2,
        loc="outside upper center",
    )
    figure.savefig(path, dpi=150)


def _colour(m: int) -> Any:
    return _COLOURS[m % len(_COLOURS)]
