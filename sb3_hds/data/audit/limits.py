"""Positions at end stops that the twin does not simulate."""

import dataclasses
from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sb3_hds.core.numerics.compilation import QUICKEST_COMPILATION
from sb3_hds.core.twin import Twin
from sb3_hds.core.types import Params
from sb3_hds.data.audit.finding import Finding, listed, percent
from sb3_hds.data.audit.stretches import Stretch, runs

# Of the range: stops are soft, and sensors noisy.
_MARGIN = 0.002


@dataclasses.dataclass(frozen=True)
class ReachedLimit(Finding):
    """
    :param value: end of the range of the joint
    :param unit: of the value
    :param share: of the samples that are at that end
    """

    value: float
    unit: str
    share: float

    @property
    def sentence(self) -> str:
        return (
            f"Joint '{self.channel}' is at its limit of {self.value:.4g} {self.unit} in "
            f"{percent(self.share)} of the samples ({listed(self.places)})."
        )

    remedy = (
        "The twin has no stops, so what happens there is none of its forces: leave these samples "
        "out, or correct the range in the model file."
    )


def reached_limits(stretches: Sequence[Stretch], twin: Twin) -> list[ReachedLimit]:
    """:return: one for each joint that reaches an end of the range that the twin declares"""
    ends = np.array([(joint.low, joint.high) for joint in twin.joints]).reshape(-1, 2)
    limited = np.flatnonzero(np.isfinite(ends).all(1)).tolist()
    if not limited:
        return []
    with jax.enable_x64(True):
        read = [
            np.asarray(_coordinates(twin, jnp.asarray(stretch.obs), twin.params))
            for stretch in stretches
        ]
    n_rows = sum(map(len, read))
    found = []
    for j in limited:
        low, high = ends[j]
        margin = _MARGIN * (high - low)
        for end, sign in ((low, -1.0), (high, 1.0)):
            there = [sign * (q[:, j] - end) >= -margin for q in read]
            places = tuple(
                stretch.place(a, b - 1)
                for stretch, flags in zip(stretches, there, strict=True)
                for a, b in runs(flags)
            )
            if places:
                share = sum(int(flags.sum()) for flags in there) / n_rows
                joint = twin.joints[j]
                found.append(ReachedLimit(joint.name, places, float(end), joint.unit, share))
    return found


@partial(jax.jit, static_argnums=0, compiler_options=QUICKEST_COMPILATION)
def _coordinates(
    twin: Twin, obs: Float[Array, "rows n_obs"], params: Params
) -> Float[Array, "rows dof"]:
    return jax.vmap(lambda row: twin.coordinates(twin.infer(row, params).q))(obs)
