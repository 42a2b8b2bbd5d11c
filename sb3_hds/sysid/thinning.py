"""Data that come faster than a diagnosis needs them, and the twin that fits."""

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from sb3_hds.core import Trajectories, Twin, rk4
from sb3_hds.core.layers import plant_of

# Interval that windows of a second need at most, and sub-steps that Runge-Kutta needs [s].
_INTERVAL, _SUBSTEP = 0.01, 0.005


class Thinned(NamedTuple):
    """
    :param twin: with the longer interval
    :param data: every so manieth observation, and the mean of the commands in between
    :param every: 1 where nothing was changed
    """

    twin: Twin
    data: Trajectories
    every: int


def thinned(twin: Twin, data: Trajectories) -> Thinned:
    """
    A hundred samples a second tell as much about a mechanism as a thousand, at a tenth of the cost.

    Where the twin integrates by Runge-Kutta, its sub-steps may become longer, up to 5 ms; those of
    other integrators, whose error is a part of the model, stay as they are.

    :param data: sampled at the twin's ``dt``
    """
    every = min(round(_INTERVAL / data.dt), int(data.lengths.min()))
    if every <= 1:
        return Thinned(twin, data, 1)
    dt, inner = every * data.dt, twin.dt / twin.substeps
    if getattr(plant_of(twin), "integrator", None) is rk4:
        inner = max(inner, _SUBSTEP)
    pieces = [_every(*data.episode(i), every) for i in range(len(data))]
    obs, actions = (list(leaves) for leaves in zip(*pieces, strict=True))
    coarse = Trajectories.from_arrays(obs, actions, dt=dt, conditions=data.conditions)
    coarse = dataclasses.replace(coarse, origin=data.origin, report=data.report)
    return Thinned(twin.at_interval(dt, math.ceil(dt / inner - 1e-9)), coarse, every)


def _every(obs: np.ndarray, actions: np.ndarray, every: int) -> tuple[np.ndarray, np.ndarray]:
    n = len(actions) // every
    means = actions[: n * every].reshape(n, every, actions.shape[1]).mean(1)
    return obs[: n * every + 1 : every], means
