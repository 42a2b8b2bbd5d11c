"""Whether there is enough motion, and enough of it caused by the commands."""

from collections.abc import Sequence

import numpy as np

from sb3_hds.core.trajectories import Trajectories
from sb3_hds.data.finding import Finding, Place
from sb3_hds.data.findings import (
    ConstantCommand,
    DependentCommand,
    MostlyStill,
    StandingStill,
    TooShort,
    WeakMotion,
    WithinNoise,
)
from sb3_hds.data.stillness import Stillness

NEEDED = 100  # steps: with fewer, hardly any effect stands out from chance
_THROUGHOUT = 0.95  # share of the time
_MOSTLY = 0.8  # share of the time
_WEAK = 5.0  # noise
_DEPENDENT = 0.999  # share of the variance


def excitation(
    data: Trajectories, stillness: Stillness, obs: Sequence[str], actions: Sequence[str]
) -> list[Finding]:
    """
    :param data: at one interval
    :param stillness: of the same data
    :param obs: names of the observation channels
    :param actions: names of the action channels
    """
    places = tuple(Place(f"trajectory {i}", 0, int(n), i) for i, n in enumerate(data.lengths))
    found: list[Finding] = []
    if data.n_steps < NEEDED:
        found.append(TooShort("all channels", places, data.n_steps, NEEDED))
    episodes = [data.episode(i) for i in range(len(data))]
    x, u = (
        np.concatenate(parts) for parts in zip(*((o[:-1], a) for o, a in episodes), strict=True)
    )
    moves = np.ptp(x, axis=0).any()
    if stillness.share >= _THROUGHOUT or not moves:
        return [*found, StandingStill("all channels", places, stillness.share if moves else 1.0)]
    if stillness.share >= _MOSTLY:
        found.append(MostlyStill("all channels", places, stillness.share))
    spread = x.std(axis=0)
    ratios = spread / np.maximum(stillness.noise, 1e-300)  # nan where the noise is not known
    if (ratios < _WEAK).all():
        return [*found, WithinNoise("all channels", places, float(ratios.max()))]
    weak = zip(obs, ratios.tolist(), strict=True)
    found += [WeakMotion(name, places, ratio) for name, ratio in weak if ratio < _WEAK]
    for j, name in enumerate(actions):
        if np.ptp(u[:, j]) == 0.0:
            found.append(ConstantCommand(name, places, float(u[0, j])))
        elif (r2 := _r2(x, u[:, j])) > _DEPENDENT:
            found.append(DependentCommand(name, places, r2))
    return found


def _r2(x: np.ndarray, u: np.ndarray) -> float:
    """Share of the variance of u that is a linear function of x."""
    if len(x) < 10 * x.shape[1]:
        return 0.0
    regressors = np.column_stack([(x - x.mean(0)) / np.maximum(x.std(0), 1e-300), np.ones(len(x))])
    fitted = regressors @ np.linalg.lstsq(regressors, u, rcond=None)[0]
    return float(1.0 - np.var(u - fitted) / np.var(u))
