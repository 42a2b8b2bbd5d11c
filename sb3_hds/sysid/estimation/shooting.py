"""
Multiple shooting: measured data in short windows, each simulated from a start state of its own.

Short windows limit the sensitivity of a chaotic or unstable system to its start, and free start
states keep the noise of one measurement from biasing an entire window.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from sb3_hds.core import (
    NO_EFFECTS,
    Effect,
    EffectChain,
    ExtendedTwin,
    Obs,
    Params,
    State,
    Trajectories,
    Twin,
    solve_spd,
)
from sb3_hds.core.twin import layers_of
from sb3_hds.errors import TrajectoryError

# Error of a simulation that is not finite, in units of the noise.
_NOT_FINITE = 1e6
# Added to the normal equations of a start state, relative to their diagonal.
_DAMPING = 1e-9
# Time before a window in which memory of unknown kind, as of a wrapper, is filled, in periods of
# the motion.
_LEAD = Effect.forgets
Offset = Float[Array, " tangent"]


class Shots(NamedTuple):
    """
    Windows of equal length, of NumPy or JAX. Leaves have one row for each window.

    :param obs: shape ``(n, steps + 1, n_obs)``
    :param actions: shape ``(n, steps, n_act)``
    :param lead_obs: before the window, shape ``(n, lead, n_obs)``
    :param lead_actions: before the window, shape ``(n, lead, n_act)``
    :param lead_known: 0 where the episode had not begun yet, shape ``(n, lead)``
    :param weight: 1, or 0 for a row that only fills up the shape
    """

    obs: Any
    actions: Any
    lead_obs: Any
    lead_actions: Any
    lead_known: Any
    weight: Any

    @property
    def n(self) -> int:
        """Number of rows, those that only fill up the shape among them."""
        return len(self.weight)

    def rows(self, index: np.ndarray) -> "Shots":
        """:return: some of the windows, by their indices or a mask of shape ``(n,)``"""
        return Shots(*(np.asarray(leaf)[index] for leaf in self))


def evenly(n: int, most: int) -> np.ndarray:
    """:return: ``most`` of ``n`` indices, equally spaced; all of them if there are fewer"""
    return np.arange(n) if n <= most else np.round(np.linspace(0, n - 1, most)).astype(int)


def shots_of(
    data: Trajectories,
    length: int,
    twin: Twin,
    n_rows: int | None = None,
    seed: int | None = 0,
    period: float = 1.0,
) -> tuple[Shots, np.ndarray]:
    """
    Cut recordings into windows that share no measurement, so that their errors are independent.

    :param data: trajectories sampled at the twin's ``dt``
    :param length: steps of a window
    :param twin: determines how many commands before a window matter, because the twin has memory
    :param n_rows: fixed number of rows: a random choice of more windows, or padding of fewer, so
        that a compiled program is reused when data are added
    :param seed: of that choice; None takes the latest windows instead
    :param period: of the motion [s], in which the twin's memory forgets
    :return: the windows, in order of recording and time, and for each the recording that it is
        from; padding has -1
    :raises TrajectoryError: if no recording is long enough
    """
    cuts = _windows_in(data, length)
    n = len(cuts) if n_rows is None else n_rows
    lead = n_steps_of(remembered_for(twin, period), data.dt)
    cuts = [cuts[i] for i in _chosen(len(cuts), n, seed)]
    rows = [_cut(data, i, k, length, lead) for i, k in cuts]
    padding = [rows[0]._replace(weight=np.zeros(()))] * (n - len(rows))
    shots = Shots(*(np.stack(leaves) for leaves in zip(*rows, *padding, strict=True)))
    origin = np.array([data.origin[i] for i, _ in cuts] + [-1] * len(padding))
    return shots, origin


def places_and_ages_of(
    data: Trajectories, length: int, n_rows: int | None = None, seed: int | None = 0
) -> tuple[np.ndarray, np.ndarray]:
    """
    :return: of each window of :func:`shots_of`, how many windows of its recording come before it,
        and how many steps there are from its beginning to the end of the data; padding has -1
    """
    cuts = _windows_in(data, length)
    before = np.cumsum(data.lengths) - data.lengths
    begins = np.array([before[i] + k for i, k in cuts])
    origin = data.origin[[i for i, _ in cuts]]
    place = np.zeros(len(cuts), int)
    for number in np.unique(origin):
        place[origin == number] = np.arange(np.sum(origin == number))
    n = len(cuts) if n_rows is None else n_rows
    chosen = _chosen(len(cuts), n, seed)
    filled = np.full((2, n), -1)
    filled[:, : len(chosen)] = place[chosen], data.n_steps - begins[chosen]
    return filled[0], filled[1]


def _windows_in(data: Trajectories, length: int) -> list[tuple[int, int]]:
    """
    :return: trajectory and first step of all windows that share no measurement
    :raises TrajectoryError: if no recording is long enough
    """
    cuts = [
        (i, k) for i, n in enumerate(data.lengths) for k in range(0, n - length + 1, length + 1)
    ]
    if not cuts:
        raise TrajectoryError(
            f"No recording has {length} steps; the longest has {data.lengths.max()}. "
            "Ask for shorter windows, or record for longer."
        )
    return cuts


def _chosen(n_windows: int, n_rows: int, seed: int | None) -> np.ndarray:
    """:return: indices of the windows that are used, in order"""
    if n_windows <= n_rows:
        return np.arange(n_windows)
    if seed is None:
        return np.arange(n_windows)[-n_rows:]
    return np.sort(np.random.default_rng(seed).choice(n_windows, n_rows, replace=False))


def simulate(
    twin: Twin,
    params: Params,
    shot: Shots,
    offset: Offset,
    n_lead: Array | None = None,
    effects: EffectChain = NO_EFFECTS,
) -> Float[Array, "rows obs"]:
    """
    Simulate one window; measured motion and commands before it fill the twin's memory.

    :param shot: one window
    :param offset: of the start state from the first measurement, as a tangent vector of positions
        and velocities
    :param n_lead: how many of the steps before the window are simulated, the last ones; default:
        all. Where it is given, only forward derivatives can be taken.
    :param effects: besides those of the twin, or which of them are computed
    :return: what the twin's sensors would have reported, shape ``(steps + 1, n_obs)``
    """
    lead, steps = shot.lead_actions.shape[0], shot.actions.shape[0]
    obs = jnp.concatenate([shot.lead_obs, shot.obs[:-1]])
    actions = jnp.concatenate([shot.lead_actions, shot.actions])
    known = jnp.concatenate([shot.lead_known, jnp.ones(steps)]) > 0.0

    def advance(i: Array, now: tuple[State, Array]) -> tuple[State, Array]:
        state, simulated = now
        place = i - lead
        seen = twin.infer(obs[i], params)
        seen = moved_by(twin, seen, jnp.where(place == 0, offset, 0.0))
        q, v = (jnp.where(place > 0, *pair) for pair in zip(state[:2], seen[:2], strict=True))
        state = State(q, v, state.memory)
        after = twin.step(state, actions[i], params, effects)
        memory = jax.tree.map(
            lambda new, old: jnp.where(known[i], new, old), after.memory, state.memory
        )
        row = jnp.maximum(place, 0)
        return after._replace(memory=memory), simulated.at[row].set(twin.observe(state, params))

    begin = 0 if n_lead is None else lead - n_lead
    first = twin.infer(obs[begin], params)
    rows = jnp.zeros((steps, obs.shape[1]), twin.observe(first, params).dtype)
    last, simulated = jax.lax.fori_loop(begin, lead + steps, advance, (first, rows))
    return jnp.concatenate([simulated, twin.observe(last, params)[None]])


def n_free(twin: Twin) -> int:
    """:return: dimension of a start state: positions and velocities"""
    return 2 * len(twin.joints)


def residuals(
    twin: Twin,
    params: Params,
    shot: Shots,
    offset: Offset,
    noise: Obs,
) -> Float[Array, " residuals"]:
    """
    :return: simulated minus measured, in units of the noise, flattened; zero for padding, and large
        where the simulation is not finite
    """
    error = (simulate(twin, params, shot, offset) - shot.obs) / noise
    error = jnp.where(jnp.isfinite(error), error, _NOT_FINITE).ravel()
    return jnp.sqrt(shot.weight) * error


def with_slopes(function: Callable[[Array], Any], x: Float[Array, " x"]) -> tuple[Any, Any]:
    """
    :param function: of a vector, to a tree of arrays
    :return: what it returns, and its slopes, an axis longer: from one simulation
    """
    along = lambda way: jax.jvp(function, (x,), (way,))  # noqa: E731
    return jax.vmap(along, out_axes=(None, -1))(jnp.eye(len(x), dtype=x.dtype))


def fit_start(
    twin: Twin,
    params: Params,
    shot: Shots,
    noise: Obs,
    first: Offset,
    n_iterations: int,
) -> Offset:
    """
    Fit the start state of one window by Gauss-Newton steps, each of which is taken only if it
    lowers the error.

    :param first: where to begin
    :return: the offset, without derivative
    """

    def error(offset: Offset) -> Array:
        return residuals(twin, params, shot, offset, noise)

    def improve(_: Array, offset: Offset) -> Offset:
        now, slopes = with_slopes(error, offset)
        step = -solve_normal(slopes, now)
        # Half a step is tried too: far from the optimum, a full one often overshoots.
        candidates = jnp.stack([offset, offset + 0.5 * step, offset + step])
        costs = jax.vmap(lambda x: jnp.sum(error(x) ** 2))(candidates)
        costs = jnp.where(jnp.isfinite(costs), costs, jnp.inf)
        return candidates[jnp.argmin(costs)]

    return jax.lax.stop_gradient(jax.lax.fori_loop(0, n_iterations, improve, first))


def solve_normal(slopes: Array, right: Array) -> Array:
    """
    :return: least-squares solution of ``slopes @ x = right`` by the normal equations, which are
        tiny; zero along a direction without slope
    """
    normal = slopes.T @ slopes
    normal = normal + (_DAMPING * jnp.trace(normal) + 1e-300) * jnp.eye(normal.shape[0])
    return solve_spd(normal, slopes.T @ right)


def eliminate_start(errors: Array, slopes: Array, n: int) -> tuple[Array, Array, Array]:
    """
    :param errors: of a window
    :param slopes: by ``n`` parameters, then by the start state
    :return: errors and slopes by the parameters, start state eliminated, and how it follows both
    """
    by_theta, by_start = slopes[:, :n], slopes[:, n:]
    both = jnp.concatenate([errors[:, None], by_theta], 1)
    moves = jax.vmap(partial(solve_normal, by_start), 1, 1)(both)
    free = both - by_start @ moves
    return free[:, 0], free[:, 1:], moves


def moved_by(twin: Twin, state: State, offset: Offset) -> State:
    """:return: the state with positions and velocities moved along a tangent vector"""
    rest = ravel_pytree(state.memory)[0]
    return twin.retract(state, jnp.concatenate([offset, jnp.zeros_like(rest)]))


def remembered_for(twin: Twin, period: float = 1.0) -> float:
    """
    :param period: of the motion [s]
    :return: time before a window that the twin's memory depends on [s]
    """
    obs = jnp.zeros(len(twin.channels))
    memory = jax.eval_shape(lambda: twin.infer(obs, twin.params).memory)
    extended = (layer for layer in layers_of(twin) if isinstance(layer, ExtendedTwin))
    attached = {a.key: a.effect for layer in extended for a in layer.attached}
    return max(
        (
            remembers_for(attached[key], period) if key in attached else _LEAD * period
            for key, leaf in memory.items()
            if jax.tree.leaves(leaf)
        ),
        default=0.0,
    )


def remembers_for(effect: Effect, period: float) -> float:
    """:return: time after which an effect's memory has forgotten its start [s]"""
    return getattr(effect, "longest", effect.forgets * period)


def n_steps_of(seconds: float, dt: float) -> int:
    """:return: steps that cover a time"""
    return int(np.ceil(seconds / dt - 1e-9))


def _cut(data: Trajectories, i: int, k: int, length: int, lead: int) -> Shots:
    before = np.arange(k - lead, k)
    known = before >= 0
    before = np.maximum(before, 0)
    return Shots(
        data.obs[i, k : k + length + 1],
        data.actions[i, k : k + length],
        data.obs[i, before],
        data.actions[i, before],
        known.astype(float),
        np.ones(()),
    )
