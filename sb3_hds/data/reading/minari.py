"""Minari data sets."""

import importlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from sb3_hds.data.columns import Columns, Entry
from sb3_hds.data.reading.log import Log
from sb3_hds.errors import TrajectoryError

PREFIX = "minari:"


def read_minari(name: str) -> Log:
    """
    Episodes of a local data set, as installed by ``minari download``.

    Minari's convention is ours: T actions and T + 1 observations. It stores no sampling interval,
    so ``columns`` must give ``dt``. Channels are called ``observations[0]``, ``actions[0]``, or
    ``observations.arm[0]`` for nested spaces.

    :param name: of the data set, such as ``"D4RL/pen/human-v2"``
    :return: one table per episode, and all channels
    :raises TrajectoryError: if Minari is not installed or has no such data set
    """
    try:
        minari = importlib.import_module("minari")
    except ImportError as error:
        raise TrajectoryError(
            "Minari data sets need the extra 'minari': pip install sb3-hds[minari]."
        ) from error
    try:
        dataset = minari.load_dataset(name)
    except (OSError, ValueError) as error:  # it raises these for an unknown name
        local = ", ".join(minari.list_local_datasets()) or "none"
        raise TrajectoryError(
            f"Minari has no data set '{name}' on this machine ({error}). Local data sets: {local}. "
            f"Download it first: minari download {name}."
        ) from error
    tables, own = [], Columns()
    for episode in dataset.iterate_episodes():
        obs = _flat("observations", episode.observations)
        actions = _flat("actions", episode.actions)
        own = Columns(
            obs=tuple(Entry(name, name) for name in obs),
            actions=tuple(Entry(name, name) for name in actions),
        )
        # Row k has the action that follows it; the last row has none.
        tables.append(obs | {n: np.append(column, np.nan) for n, column in actions.items()})
    if not tables:
        raise TrajectoryError(f"Minari's data set '{name}' has no episodes.")
    return Log(tables, own)


def _flat(name: str, values: Any) -> dict[str, np.ndarray]:
    """Nested dicts and tuples of arrays, as columns of shape ``(rows,)``."""
    if isinstance(values, tuple):
        values = {str(i): part for i, part in enumerate(values)}
    if isinstance(values, Mapping):
        parts = (_flat(f"{name}.{key}", part) for key, part in values.items())
        return {n: column for part in parts for n, column in part.items()}
    matrix = np.asarray(values, np.float64)
    matrix = matrix.reshape(len(matrix), -1)
    return {f"{name}[{i}]": column for i, column in enumerate(matrix.T)}
