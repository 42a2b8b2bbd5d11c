"""Data that come faster than a diagnosis needs them, and the twin that fits."""

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from sb3_hds.core import Trajectories, Twin, rk4
from sb3_hds.core.twin import plant_of

# Samples and sub-steps of Runge-Kutta that a period of the motion needs.
_SAMPLES, _SUBSTEPS = 100, 200


class Thinned(NamedTuple):
    """
    :param twin: with the longer interval
    :param data: every n-th observation, and the mean of the commands in between
    :param every: 1 where nothing was changed
    """

    twin: Twin
    data: Trajectories
    every: int


def thinned(twin: Twin, data: Trajectories, period: float) -> Thinned:
    """
    A hundred samples of a period tell as much about a mechanism as a thousand, at a tenth of the
    cost.

    Where the twin integrates by Runge-Kutta, its sub-steps may become longer, up to a two-hundredth
    of a period; those of other integrators, whose error is a part of the model, stay as they are.

    :param data: sampled at the twin's ``dt``
    :param period: of the fastest motion in them [s]
    """
    every = min(round(period / _SAMPLES / data.dt), int(data.lengths.min()))
    if every <= 1:
        return Thinned(twin, data, 1)
    dt, inner = every * data.dt, twin.dt / twin.substeps
    if getattr(plant_of(twin), "integrator", None) is rk4:
        inner = max(inner, period / _SUBSTEPS)
    pieces = [_every(*data.episode(i), every) for i in range(len(data))]
    obs, actions = (list(leaves) for leaves in zip(*pieces, strict=True))
    coarse = Trajectories.from_arrays(obs, actions, dt=dt, conditions=data.conditions)
    coarse = dataclasses.replace(coarse, origin=data.origin, report=data.report)
    return Thinned(twin.at_interval(dt, math.ceil(dt / inner - 1e-9)), coarse, every)


def _every(obs: np.ndarray, actions: np.ndarray, every: int) -> tuple[np.ndarray, np.ndarray]:
    n = len(actions) // every
    means = actions[: n * every].reshape(n, every, actions.shape[1]).mean(1)
    return obs[: n * every + 1 : every], means
