"""Effects between the plant and the measurement."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from sb3_hds.core import Memory, Parameter, Params, Scalar, SensorEffect
from sb3_hds.core.twin import plant_of
from sb3_hds.effects.shapes import Delayed
from sb3_hds.errors import EffectError

if TYPE_CHECKING:
    from sb3_hds.core import Twin


class SensorBias(SensorEffect):
    r"""
    A sensor has a constant error.

    .. math:: y' = y + \beta

    A wrong zero of an angle that is measured as cosine and sine is not such a bias: it rotates
    both.

    Source: *International vocabulary of metrology*, JCGM 200:2012, 4.20 (instrumental bias).
    """

    name = "sensor_bias"
    parameters = {"bias": Parameter(null=0.0, scale=0.05, unit="channel unit")}
    explanation = "A sensor reports too much, or too little, by the same amount all the time."
    source = "JCGM 200:2012, 4.20"
    equivalents = {
        "parameter.gravity_x": "in free swing, where it is a tilt of the whole system",
        "parameter.tilt": "in free swing, of an angle: the zero of a sensor or of gravity",
    }

    def sense(self, measured: Scalar, memory: Memory, dt: float, params: Params) -> Scalar:
        return measured + params["bias"]

    def invert(self, reported: Scalar, params: Params) -> Scalar:
        return reported - params["bias"]


class SensorScale(SensorEffect):
    r"""
    A sensor reports too much, or too little, in proportion.

    .. math:: y' = k\,y

    A factor below zero is :class:`SignFlip`.

    Source: *International vocabulary of metrology*, JCGM 200:2012, 4.12 (sensitivity).
    """

    name = "sensor_scale"
    parameters = {"scale": Parameter(null=1.0, scale=0.05, unit="1", lower=0.1, upper=10.0)}
    explanation = "A sensor reports too much, or too little, in proportion, as in a wrong unit."
    source = "JCGM 200:2012, 4.12"

    def sense(self, measured: Scalar, memory: Memory, dt: float, params: Params) -> Scalar:
        return params["scale"] * measured

    def invert(self, reported: Scalar, params: Params) -> Scalar:
        return reported / params["scale"]


class SensorDelay(Delayed, SensorEffect):
    r"""
    A sensor reports the past.

    .. math:: y'(t) = y(t - d)

    Samples are interpolated linearly, so the delay need not be a multiple of the control interval;
    at a multiple the derivative is the one-sided one towards larger delays. Before an episode the
    channel is assumed constant, so the first report is exact.

    Source: Åström and Murray, *Feedback Systems*, Princeton University Press 2021, section 10.

    :param longest: option; longest delay that can be simulated [s]
    :raises EffectError: unless it is positive
    """

    name = "sensor_delay"
    explanation = "Measurements arrive late, as from a camera or a filter."
    source = "Åström and Murray 2021, section 10"
    equivalents = {"action_delay": "where every channel is as late and nothing is fed back"}

    def memory(self, measured: Scalar, twin: "Twin") -> Memory:
        """The last measurements, the latest first."""
        return jnp.full(self.remembered(twin.dt), measured)

    def sense(self, measured: Scalar, memory: Memory, dt: float, params: Params) -> Scalar:
        # A state that was changed without its memory is reported without delay.
        values = memory.at[0].set(measured)
        age = params["delay"] / dt
        younger = jnp.clip(jnp.floor(age).astype(int), 0, len(memory) - 2)
        share = age - younger
        return (1.0 - share) * values[younger] + share * values[younger + 1]

    def invert(self, reported: Scalar, params: Params) -> Scalar:
        return reported

    def advance(self, measured: Scalar, memory: Memory, dt: float, params: Params) -> Memory:
        return jnp.concatenate([measured[None], memory[:-1]])


class SignFlip(SensorEffect):
    r"""
    A sensor has the wrong sign: it is mounted or wired the wrong way round.

    .. math:: y' = \begin{cases} y & f < 1/2 \\ -y & f \ge 1/2 \end{cases}

    The parameter :math:`f` is a switch, off at 0 and on at 1, without a derivative. If the
    direction of a joint is wrong, both its position and its velocity are: :func:`reversed_joint`
    finds the channels.

    Source: *International vocabulary of metrology*, JCGM 200:2012, 4.12 (a sensitivity of -1).
    """

    name = "sign_flip"
    parameters = {"flipped": Parameter(null=0.0, scale=1.0, unit="1", lower=0.0, upper=1.0)}
    explanation = (
        "A sensor reports the wrong sign, because it is mounted or wired the wrong way round."
    )
    source = "JCGM 200:2012, 4.12"

    def sense(self, measured: Scalar, memory: Memory, dt: float, params: Params) -> Scalar:
        return jnp.where(params["flipped"] >= 0.5, -measured, measured)

    def invert(self, reported: Scalar, params: Params) -> Scalar:
        return jnp.where(params["flipped"] >= 0.5, -reported, reported)


def reversed_joint(twin: "Twin", joint: int | str) -> tuple[SignFlip, ...]:
    """
    The sensor effects of a joint whose direction is reversed.

    :param joint: index or name
    :return: a flip for each channel that changes sign with position and velocity of the joint: of a
        pendulum the sine and the speed, and not the cosine
    :raises EffectError: for an unknown joint, or a channel that changes in another way than by its
        sign
    """
    twin = plant_of(twin)
    names = [each.name for each in twin.joints]
    index = names.index(joint) if joint in names else joint
    if not isinstance(index, int) or not 0 <= index < len(names):
        raise EffectError(f"{twin.name} has no joint {joint!r}. It has: {', '.join(names)}.")
    state = twin.initial(jax.random.key(0), twin.params)
    # A position and a velocity at which no channel is zero by chance.
    q, v = 0.3 + 0.1 * jnp.arange(len(names)), 0.7 - 0.1 * jnp.arange(len(names))
    turned = [x.at[index].multiply(-1.0) for x in (q, v)]
    before, after = (
        np.asarray(twin.observe(state._replace(q=x, v=y), twin.params)) for x, y in ((q, v), turned)
    )
    changed = ~np.isclose(after, before)
    odd = changed & np.isclose(after, -before)
    channels = np.array([channel.name for channel in twin.channels])
    if (changed & ~odd).any():
        raise EffectError(
            f"Reversing {names[index]} changes more than the sign of: "
            f"{', '.join(channels[changed & ~odd])}. SignFlip cannot represent that."
        )
    return tuple(SignFlip(name, flipped=1.0) for name in channels[odd].tolist())
