"""Velocities that come a fraction of a sample late: how they were computed, not what is wrong."""

import jax
import jax.numpy as jnp
import numpy as np

from sb3_hds.core import Trajectories, Twin, rollout
from sb3_hds.data.audit.results import shifted
from sb3_hds.data.audit.velocity import Lag, lags_of

# Longest shift that is taken for a matter of computation [samples], [s], and the least that counts.
_SAMPLES, _SECONDS, _VISIBLE = 1.0, 2e-3, 0.1
_SIGMAS = 3.0
# Of each recording, and of them, to see what the twin's own velocities do.
_STEPS, _RECORDINGS = 1000, 4


def in_step(twin: Twin, data: Trajectories) -> tuple[Trajectories, tuple[str, ...]]:
    """
    Velocities moved to where those of the twin are, relative to its positions.

    A rig that differentiates and filters its encoders reports velocities late by a part of a
    sample; at a high rate this is seen, and is not worth a name. A backward difference is half a
    sample late at any rate, and is no sensor's delay.

    :return: the data, and what was changed, in words
    """
    names = [channel.name for channel in twin.channels]
    measured = [lag for lag in lags_of(data, names) if _short(lag, data.dt)]
    if not measured:
        return data, ()
    own = {lag.velocity: lag.samples for lag in lags_of(_replayed(twin, data), names)}
    late = {
        lag: (0.5 if lag.backward else lag.samples) - own[lag.velocity]
        for lag in measured
        if lag.velocity in own
    }
    late = {lag: samples for lag, samples in late.items() if abs(samples) > _VISIBLE}
    if not late:
        return data, ()
    words = tuple(_in_words(lag, names[lag.velocity], n, data.dt) for lag, n in late.items())
    return shifted(data, {lag.velocity: samples for lag, samples in late.items()}), words


def _in_words(lag: Lag, name: str, samples: float, dt: float) -> str:
    time = f"{1e3 * abs(samples) * dt:.2g} ms ({abs(samples):.2g} samples)"
    if lag.backward:
        return (
            f"{name} is the backward difference of {lag.position}, and so {time} late; it was "
            "moved back. No sensor delays it."
        )
    when = "after" if samples > 0.0 else "before"
    return (
        f"{name} comes {time} {when} the position that it belongs to, as filters do; it was moved "
        "back."
    )


def _short(lag: Lag, dt: float) -> bool:
    if lag.backward:
        return True
    short = abs(lag.samples) <= _SAMPLES and abs(lag.samples) * dt <= _SECONDS
    return short and abs(lag.samples) > max(_VISIBLE, _SIGMAS * lag.stderr)


def _replayed(twin: Twin, data: Trajectories) -> Trajectories:
    """The same commands, simulated."""
    n = min(int(data.lengths.min()), _STEPS)
    obs, actions = data.obs[:_RECORDINGS, 0], data.actions[:_RECORDINGS, :n]

    def one(first: jax.Array, commands: jax.Array) -> jax.Array:
        states = rollout(twin, twin.params, twin.infer(first, twin.params), commands).states
        return jax.vmap(lambda state: twin.observe(state, twin.params))(states)

    with jax.enable_x64(True):
        simulated = np.asarray(jax.jit(jax.vmap(one))(jnp.asarray(obs), jnp.asarray(actions)))
    if not np.isfinite(simulated).all():
        return data
    return Trajectories.from_arrays(list(simulated), list(actions), dt=data.dt)
