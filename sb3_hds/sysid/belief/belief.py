"""A belief over twins, from the answers that a diagnosis leaves open, and as a file."""

import os
from pathlib import Path

import numpy as np
import yaml
from jaxtyping import Float

from sb3_hds.core.belief import BeliefTwin
from sb3_hds.core.trajectories.storage import check_target, write_bytes
from sb3_hds.sysid.belief.answers import Answers, bounds_of, union

# Number of times that a draw out of its physical bounds is repeated before it is clipped to them.
_TRIES = 50
_HEAD = """\
# What measured data leave open about {name}, for domain randomisation.
# One draw is a row of `draws`: its numbers belong together, in the order of `parameters`. Draw
# entire rows, all equally likely; `mean`, `std`, `low` and `high` (5 % and 95 %) describe one
# parameter at a time, without correlations.
"""


def belief_of(answers: Answers, n: int = 64, seed: int = 0) -> BeliefTwin:
    r"""
    Draws from :math:`\sum_m w_m \, N(\theta_m, L_m L_m^T)`, each normal cut off at the physical
    bounds: :math:`w_m` is proportional to the likelihood of answer :math:`m` on held-out
    recordings, in which correlated errors count as fewer, times its prior odds.

    :param answers: that the data leave open
    :param n: draws; each answer has its share of them, to one draw, and at least one
    :param seed: of the draws
    :return: one twin with everything that any answer has; draw 0 is the likeliest answer as fitted
    """
    twin, values, factor = union(answers.answers)
    rng, bounds = np.random.default_rng(seed), bounds_of(twin)
    # The likeliest answer has the remaining draws.
    counts = np.maximum(np.round(answers.weights * n).astype(int), 1)
    counts[0] = max(n - counts[1:].sum(), 1)
    origin = np.repeat(np.arange(len(counts)), counts)
    draws = np.stack([_drawn(rng, values[m], factor[m], *bounds) for m in origin])
    draws[0] = values[0]
    names = [answer.name for answer in answers.answers]
    return BeliefTwin(twin, draws, origin, names, tuple(answers.weights))


def _drawn(
    rng: np.random.Generator,
    value: Float[np.ndarray, " p"],
    factor: Float[np.ndarray, "p k"],
    low: Float[np.ndarray, " p"],
    high: Float[np.ndarray, " p"],
) -> Float[np.ndarray, " p"]:
    for _ in range(_TRIES):
        drawn = value + factor @ rng.standard_normal(factor.shape[1])
        if np.all((low <= drawn) & (drawn <= high)):
            return drawn
    return np.clip(drawn, low, high)


def write_randomisation(belief: BeliefTwin, path: str | os.PathLike[str]) -> Path:
    """
    Write what differs between draws as YAML: ``parameters`` by full name with unit, mean, standard
    deviation and quantiles; ``draws``; and the ``answers`` with their weights.

    :param path: of the file; an existing one is replaced
    :return: its path
    :raises OSError: if there is no folder to write it in
    """
    check_target(path)
    names = tuple(belief.base.parameters)
    varied = [names.index(name) for name in belief.varied]
    described = {
        "twin": belief.name,
        "answers": dict(zip(belief.answers, map(_short, belief.weights), strict=True)),
        "parameters": {names[j]: _described(belief, j) for j in varied},
        "fixed": {name: _short(value) for name, value in belief.values.items()},
        "draws": [[_short(value) for value in row] for row in belief.draws[:, varied]],
    }
    text = yaml.safe_dump(described, sort_keys=False, default_flow_style=None, width=100)
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
