"""Pictures of a designed experiment; matplotlib is imported only when one is drawn."""

from typing import Any, Protocol

import numpy as np

from sb3_hds.core import Trajectories

_COLOURS = ("#27496d", "#d1495b", "#8a6d1d", "#2e7d6b", "#7a4f9a", "#9a978c")
_COMMAND = "#3b3a36"
# Widths on a desk or on paper, and on a telephone [in].
_WIDE, _NARROW = 9.0, 4.4


class Designed(Protocol):
    """What is drawn of a ``NextExperiment``."""

    @property
    def commands(self) -> Trajectories: ...
    @property
    def predicted(self) -> np.ndarray: ...
    @property
    def answers(self) -> tuple[str, ...]: ...
    @property
    def channels(self) -> tuple[tuple[str, str], ...]: ...
    @property
    def actuators(self) -> tuple[tuple[str, str], ...]: ...


def plot_next(told: Designed, narrow: bool = False) -> Any:
    """The commands of the first recording, and below them each channel as each answer has it."""
    from matplotlib.figure import Figure

    rows = len(told.actuators) + len(told.channels)
    figure = Figure(figsize=(_NARROW if narrow else _WIDE, 0.8 + 1.3 * rows), layout="constrained")
    panels = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
    data = told.commands
    time = data.dt * np.arange(told.predicted.shape[2])
    for j, (name, unit) in enumerate(told.actuators):
        panels[j].step(time[:-1], data.actions[0, :, j], where="post", color=_COMMAND, lw=1.2)
        panels[j].set_ylabel(_label(name, unit), fontsize=8)
    for j, (name, unit) in enumerate(told.channels):
        axes = panels[len(told.actuators) + j]
        for i, answer in enumerate(told.answers):
            seen = told.predicted[i, 0, :, j]
            axes.plot(time, seen, color=_COLOURS[i % len(_COLOURS)], lw=1.2, label=answer)
        axes.set_ylabel(_label(name, unit), fontsize=8)
    figure.legend(
        *panels[-1].get_legend_handles_labels(),
        fontsize=8,
        frameon=False,
        ncols=1 if narrow else 3,
        loc="outside upper center",
    )
    panels[-1].set_xlabel("time [s]", fontsize=8)
    return figure


def _label(name: str, unit: str) -> str:
    return name if unit in ("", "1") else f"{name} [{unit}]"
