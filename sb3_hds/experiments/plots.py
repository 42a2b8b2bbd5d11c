"""Pictures of experiments."""

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from sb3_hds.experiments.policy_gain import PolicyGain

_COLOURS = {"believed": "#d1495b", "extended": "#27496d", "true": "#9a978c"}
_LABELS = {"believed": "in the twin\nas believed", "extended": "in the\nextended twin"}


def plot_policy_gain(gain: "PolicyGain", path: str | os.PathLike[str]) -> Path:
    """
    :param path: of the picture; a file of that name is replaced
    :raises ImportError: without matplotlib
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0, 4.0), layout="constrained")
    axes = figure.subplots()
    for place, (name, values) in enumerate(gain.returns.items()):
        found, colour = gain.of(name), _COLOURS[name]
        spread = np.linspace(-0.12, 0.12, len(values))
        axes.plot(place + spread, values.mean(1), "o", color=colour, ms=4, alpha=0.5)
        axes.plot([place] * 2, [found.low, found.high], color=colour, lw=8, alpha=0.3)
        axes.plot([place - 0.2, place + 0.2], [found.mean] * 2, color=colour, lw=2)
    names = [_LABELS.get(name, "in the\ntrue twin") for name in gain.returns]
    axes.set_xticks(range(len(names)), names)
    axes.set_ylabel("return on the real system")
    axes.set_title("where the policy was trained", fontsize=10)
    axes.spines[["top", "right"]].set_visible(False)
    target = Path(path)
    figure.savefig(target, dpi=150)
    return target
