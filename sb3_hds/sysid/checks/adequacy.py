"""Model adequacy: prediction errors of each channel, in its unit and relative to its noise."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sb3_hds.core import Channel

# A model predicts to near the noise where its error is below this multiple of it, or below this
# share of the channel's standard deviation, whichever is larger.
_NEAR, _SMALL = 3.0, 0.05
# Larger errors, in standard deviations of the channel, are those of a simulation that diverges.
_DIVERGED = 1e3


class Distance(NamedTuple):
    """
    Prediction error of a channel on held-out windows.

    :param channel: name and unit
    :param error: root mean square [channel's unit]
    :param noise: standard deviation of the sensor's noise, from fourth differences of its samples
        [channel's unit]
    :param deviation: standard deviation of the measurements [channel's unit]
    """

    channel: Channel
    error: float
    noise: float
    deviation: float

    @property
    def near(self) -> bool:
        """Whether the model predicts this channel to near its noise."""
        return self.error <= max(_NEAR * self.noise, _SMALL * self.deviation)

    def __str__(self) -> str:
        unit = f" {self.channel.unit}" if self.channel.unit else ""
        return (
            f"{self.channel.name} by {self.error:.3g}{unit}, {self.error / self.deviation:.0%} of "
            f"its standard deviation (the noise is about {self.noise:.2g}{unit})"
        )


def distances(
    channels: Sequence[Channel],
    residual: Float[np.ndarray, "n rows obs"],
    noise: Float[np.ndarray, " obs"],
    deviations: Float[np.ndarray, " obs"],
) -> tuple[Distance, ...]:
    """
    :param residual: simulated minus measured
    :param noise: of each channel
    :param deviations: standard deviation of each channel
    """
    most = (_DIVERGED * deviations) ** 2
    squares = np.minimum(np.nan_to_num(residual**2, nan=np.inf, posinf=np.inf), most)
    errors = np.sqrt(np.mean(squares, axis=(0, 1)))
    return tuple(
        Distance(channel, float(e), float(n), float(s))
        for channel, e, n, s in zip(channels, errors, noise, deviations, strict=True)
    )


def far_in_words(found: Sequence[Distance]) -> str:
    """
    :return: a sentence on the channels that are not predicted to near the noise; empty if all are
    """
    far = [one for one in found if not one.near]
    if not far:
        return ""
    return (
        f"Held-out windows are not predicted to near the noise: {'; '.join(map(str, far))}. "
        "Check zero, direction, units and order of the columns against the model."
    )
