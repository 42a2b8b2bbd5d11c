"""Values far beyond all others, which the physics of a system does not reach in one sample."""

from collections.abc import Iterator, Sequence

import numpy as np

from sb3_hds.data.findings import Outliers
from sb3_hds.data.stretches import Stretch, runs

_USUAL = 0.98  # of the samples: the range that they fill is the usual one
_FAR = 20.0  # usual ranges from the median
_AT_ONCE = 0.5  # of the way there, and of the way back, in one sample


def outliers(stretches: Sequence[Stretch], names: Sequence[str]) -> list[Outliers]:
    """
    Samples that one step leads to and one step leads back from, far beyond the usual range.

    A blow ebbs away and an unstable system does not come back: neither is one.
    """
    found = []
    tail = 0.5 * (1.0 - _USUAL)
    everything = np.concatenate([stretch.obs for stretch in stretches])
    low, middle, high = np.quantile(everything, (tail, 0.5, 1.0 - tail), axis=0)
    for j, name in enumerate(names):
        farthest = _FAR * (high[j] - low[j])
        if farthest == 0.0:
            continue
        places, values = [], []
        for stretch in stretches:
            x = stretch.obs[:, j] - middle[j]
            for a, b in _excursions(x, farthest):
                places.append(stretch.place(a, b))
                values.append(stretch.obs[a : b + 1, j][np.abs(x[a : b + 1]).argmax()])
        if places:
            worst = max(values, key=lambda value: abs(value - middle[j]))
            found.append(Outliers(name, tuple(places), float(worst), float(low[j]), float(high[j])))
    return found


def _excursions(x: np.ndarray, farthest: float) -> Iterator[tuple[int, int]]:
    """First and last row of each run beyond that begins and ends at once, or with the recording."""
    steps = np.abs(np.diff(x))
    for a, end in runs(np.abs(x) > farthest):
        goes = a == 0 or steps[a - 1] > _AT_ONCE * abs(x[a])
        comes = end == len(x) or steps[end - 1] > _AT_ONCE * abs(x[end - 1])
        if goes and comes and end - a < len(x):
            yield a, end - 1
