"""A belief as a randomisation config, for simulators that are not ours."""

import os
from pathlib import Path

import numpy as np
import yaml

from sb3_hds.core.belief import BeliefTwin
from sb3_hds.core.trajectories.storage import check_target, write_bytes

_HEAD = """\
# What measured data leave open about {name}, for domain randomisation.
# One draw is a row of `draws`: its numbers belong together, in the order of `parameters`. Draw
# whole rows, each as likely as the others; `mean`, `std`, `low` and `high` (5 % and 95 %) describe
# one parameter at a time and forget how they go together.
"""


def write_randomisation(belief: BeliefTwin, path: str | os.PathLike[str]) -> Path:
    """
    Write what differs between draws as YAML: ``parameters`` by full name with unit, mean, standard
    deviation and quantiles; ``draws``; and the ``answers`` with their weights.

    :param path: a file of that name is replaced as a whole
    :return: its path
    :raises OSError: if there is no folder to write it in
    """
    check_target(path)
    names = tuple(belief.base.parameters)
    varied = [names.index(name) for name in belief.varied]
    told = {
        "twin": belief.name,
        "answers": dict(zip(belief.answers, map(_short, belief.weights), strict=True)),
        "parameters": {names[j]: _described(belief, j) for j in varied},
        "fixed": {name: _short(value) for name, value in belief.values.items()},
        "draws": [[_short(value) for value in row] for row in belief.draws[:, varied]],
    }
    text = yaml.safe_dump(told, sort_keys=False, default_flow_style=None, width=100)
    return write_bytes(path, (_HEAD.format(name=belief.name) + text).encode())


def _described(belief: BeliefTwin, j: int) -> dict[str, float | str]:
    column, name = belief.draws[:, j], tuple(belief.base.parameters)[j]
    low, high = np.quantile(column, [0.05, 0.95])
    return {
        "unit": belief.base.parameters[name].unit,
        "mean": _short(column.mean()),
        "std": _short(column.std()),
        "low": _short(low),
        "high": _short(high),
    }


def _short(value: float) -> float:
    return float(f"{value:.6g}")
