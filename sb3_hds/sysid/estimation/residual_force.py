"""Learn the residual force of a twin: an ensemble of networks, on errors over several steps."""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from sb3_hds.core import AnalyticTwin, Params, State, Trajectories, TransformedTwin, Twin
from sb3_hds.core.twin import layers_of, plant_of
from sb3_hds.effects import NeuralForce, force_of
from sb3_hds.errors import CalibrationError
from sb3_hds.sysid.estimation.calibrate import default_window
from sb3_hds.sysid.estimation.prediction import hold_out, is_better, start_states, window_errors
from sb3_hds.sysid.estimation.shooting import Shots, places_and_ages_of, shots_of, simulate
from sb3_hds.sysid.measurements import NORMAL, channel_deviations, check_fits

# Unit of errors where the noise is not known, in standard deviations of a channel.
_UNIT_ERROR = 0.05
# Unit of the output, in shares of the typical inertial force.
_OUTPUT = 0.3
_LEARNING_RATE, _WEIGHT_DECAY = 1e-2, 1e-3
_BATCH = 32
# Every n-th training window is a validation window, for early stopping.
_EVERY = 4
# Steps between two validations; training stops after this many without gain.
_CHUNK, _PATIENCE = 50, 6
_MOST_CHUNKS = 40
# Rounds of training; between them, start states are refitted with the force as learned.
_ROUNDS = 2
# Threshold of Huber's loss, in units of the channels' scale.
_OUTLIER = 3.0


Numbers = Array | np.ndarray


class Lesson(NamedTuple):
    """
    What a force is learned from.

    :param params: full parameters of the twin
    :param scales: of the force's inputs and outputs
    :param shots: windows
    :param starts: of each window, see ``start_states``
    :param unit: what an error of one means in each channel
    """

    params: Params
    scales: dict[str, Array]
    shots: Shots
    starts: tuple[Float[Numbers, "n free"], Float[Numbers, "n residuals free"]]
    unit: Float[Numbers, " obs"]


@dataclasses.dataclass(frozen=True)
class Residual:
    """
    Result of :func:`fit_residual`.

    :param twin: with the learned force attached; its share is 1 if accepted, otherwise 0
    :param key: full name of the effect in that twin
    :param accepted: whether it predicts held-out windows better than the twin without it
    :param error_before: of each held-out window without it, in units of the channels' noise
    :param error_after: of each held-out window with it
    :param n_steps: of the optimiser
    :param disagreement: of the members over the data, in units of the normalised output
    """

    twin: Twin
    key: str
    accepted: bool
    error_before: np.ndarray
    error_after: np.ndarray
    n_steps: int
    disagreement: float


def fit_residual(
    twin: Twin,
    data: Trajectories,
    *,
    n_members: int = 5,
    net_arch: Sequence[int] = (8, 8),
    caution: float = 0.0,
    window: int | None = None,
    noise: Float[np.ndarray, " obs"] | None = None,
    n_windows: int | None = None,
    seed: int = 0,
) -> Residual:
    """
    Attach a learned force to a twin, and keep it only if it lowers the errors of held-out windows.

    Each member of the ensemble trains on a bootstrap sample of the windows, and stops when the
    errors of validation windows, a quarter of them, stop falling. Further windows, used for
    neither, decide whether the force is kept. The loss is the error over entire windows, so the
    force is learned along the simulation and through the integrator that will use it. A force that
    the twin has already continues from its weights.

    :param twin: analytic, extended or not; its values stay as they are
    :param data: measured trajectories, sampled at the twin's ``dt``
    :param n_members: networks
    :param net_arch: units of the hidden layers
    :param caution: see :class:`~sb3_hds.effects.NeuralForce`
    :param window: steps per window; default as for ``calibrate``
    :param noise: standard deviation of each channel's noise, for example ``fit.noise``; default: a
        twentieth of the channel's standard deviation
    :param n_windows: fixed number of windows, see ``calibrate``
    :param seed: of weights, bootstrap and batches
    :raises CalibrationError: for a twin without mass matrix, other channels or another interval
    :raises TrajectoryError: if no recording is as long as a window
    """
    check_fits(twin, data)
    deviations = channel_deviations(data)
    scale = _UNIT_ERROR * deviations if noise is None else np.maximum(noise, 1e-3 * deviations)
    length = window or default_window(data)
    shots, origin = shots_of(data, length, twin, n_windows, seed)
    rank = np.where(origin < 0, -1, np.searchsorted(np.unique(data.origin), origin))
    return fit_force(
        twin,
        shots,
        hold_out(rank, places_and_ages_of(data, length, n_windows, seed)[0]),
        scale,
        n_members=n_members,
        net_arch=net_arch,
        caution=caution,
        seed=seed,
    )


def fit_force(
    twin: Twin,
    shots: Shots,
    held: np.ndarray,
    scale: Float[np.ndarray, " obs"],
    *,
    n_members: int = 5,
    net_arch: Sequence[int] = (8, 8),
    caution: float = 0.0,
    seed: int = 0,
) -> Residual:
    """
    :func:`fit_residual` on windows that were cut already.

    :param shots: windows; those of weight zero do not count
    :param held: which windows are held out from training, shape ``(n,)``
    :param scale: what an error of one means in each channel
    :raises CalibrationError: for a twin without mass matrix, or too few windows
    """
    if not isinstance(plant_of(twin), AnalyticTwin) or twin.differentiability != "reverse":
        raise CalibrationError(
            f"A residual force is learned through analytic twins; {twin.name} is none. "
            "Calibrate it, or attach named effects."
        )
    real = np.asarray(shots.weight) > 0.0
    held, learned = held & real, real & ~held
    if not held.any() or learned.sum() < 2:
        raise CalibrationError(
            f"{real.sum()} windows are too few to learn from some and check on others. "
            "Record more, or ask for shorter windows."
        )
    extended = twin
    if force_of(twin) is None:
        fresh = NeuralForce(0, n_members=n_members, net_arch=net_arch, caution=caution)
        extended = twin.extend(fresh)
    attached = force_of(extended)
    assert attached is not None
    key, force = attached
    without = {**extended.params, f"{key}.share": 0.0}
    seen = _seen(extended, shots.rows(learned))
    tensors = {name: extended.tensors[f"{key}.{name}"] for name in force.tensors}
    if extended is not twin:
        tensors = _normalised(extended, force, seen, seed)
    params, n_steps = without, 0
    for _ in range(_ROUNDS):
        starts = start_states(extended, params, shots, scale)
        lesson = Lesson(extended.params, tensors, shots, starts, scale)
        tensors, n_more = _train(extended, key, lesson, learned, n_members, seed)
        extended = extended.with_tensors({f"{key}.{name}": t for name, t in tensors.items()})
        params, n_steps = {**extended.params, f"{key}.share": 1.0}, n_steps + n_more
    before = window_errors(extended, without, shots, scale)[held]
    after = window_errors(extended, params, shots, scale)[held]
    accepted = is_better(after, before)
    extended = extended.with_parameters(**{f"{key}.share": 1.0 if accepted else 0.0})
    disagree = lambda q, v, u: force.disagreement(q, v, u, tensors)  # noqa: E731
    doubt = float(jnp.mean(jax.vmap(jax.vmap(disagree))(*seen)))
    return Residual(extended, key, accepted, before, after, n_steps, doubt)


def _seen(twin: Twin, shots: Shots) -> tuple[Array, Array, Array]:
    """Position, velocity and force of the actuators at every measurement that an action follows."""
    plant, params = plant_of(twin), twin.params
    assert isinstance(plant, AnalyticTwin)

    def one(obs: Array, action: Array) -> tuple[Array, Array, Array]:
        state: State = twin.infer(obs, params)
        for layer in layers_of(twin):
            if isinstance(layer, TransformedTwin):
                action = layer.command(state, action, params)
        force = plant.actuate(state, action, params)
        return plant.coordinates(state.q), state.v, force

    obs = jnp.asarray(shots.obs[:, :-1], jnp.float32)
    return jax.vmap(jax.vmap(one))(obs, jnp.asarray(shots.actions, jnp.float32))


def _normalised(
    twin: Twin, force: NeuralForce, seen: tuple[Array, Array, Array], seed: int
) -> dict[str, Any]:
    """Random weights with the scales of the data."""
    plant, (q, v, actuator) = plant_of(twin), seen
    assert isinstance(plant, AnalyticTwin)
    inputs = jax.vmap(jax.vmap(force.inputs))(q, v, actuator)
    inputs = inputs.reshape(-1, inputs.shape[-1])
    scale = jnp.std(inputs, 0)
    masses = jax.vmap(jax.vmap(lambda q: jnp.diag(plant.mass_matrix(q, twin.params))))(q)
    pushed = masses[:, :-1] * jnp.diff(v, axis=1) / twin.dt
    inertial = jnp.median(jnp.abs(pushed), (0, 1)) * NORMAL
    size = jnp.where(inertial > 0.0, _OUTPUT * inertial, 1.0)
    return force.fresh(jax.random.key(seed)) | {
        "input_mean": jnp.mean(inputs, 0),
        "input_scale": jnp.where(scale > 1e-6, scale, 1.0),
        "output_scale": size,
    }


def _train(
    twin: Twin, key: str, lesson: Lesson, learned: np.ndarray, n_members: int, seed: int
) -> tuple[dict[str, Any], int]:
    """Adam on each member separately, with early stopping on validation windows."""
    rows = np.flatnonzero(learned)
    watched = np.isin(
        np.arange(len(learned)), rows[_EVERY - 1 :: _EVERY] if len(rows) >= _EVERY else rows[-1:]
    )
    single: Lesson = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), lesson)
    weights = single.scales.pop("weights")
    drawn = np.random.default_rng(seed).exponential(size=(n_members, len(learned)))
    drawn *= learned & ~watched
    probabilities = jnp.asarray(drawn / drawn.sum(1, keepdims=True), jnp.float32)
    state = jax.vmap(_optimiser().init)(weights)
    loss_of = lambda w: np.asarray(_watched_loss(twin, key, w, single, jnp.asarray(watched)))  # noqa: E731
    best, best_loss, idle, n_chunks = weights, loss_of(weights), 0, 0
    for k in jax.random.split(jax.random.key(seed), _MOST_CHUNKS):
        weights, state = _steps(twin, key, weights, state, single, probabilities, k)
        loss = loss_of(weights)
        n_chunks += 1
        better = loss < best_loss
        idle = 0 if (loss < 0.99 * best_loss).any() else idle + 1
        best = jax.tree.map(partial(_chosen, better), weights, best)
        best_loss = np.where(better, loss, best_loss)
        if idle >= _PATIENCE:
            break
    return lesson.scales | {"weights": best}, n_chunks * _CHUNK


def _chosen(better: np.ndarray, new: Array, old: Array) -> Array:
    """Member by member."""
    return jnp.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)


def _optimiser() -> optax.GradientTransformation:
    return optax.chain(
        optax.clip_by_global_norm(1.0),
        optax.adamw(_LEARNING_RATE, b2=0.99, weight_decay=_WEIGHT_DECAY),
    )


@partial(jax.jit, static_argnums=(0, 1))
def _steps(
    twin: Twin,
    key: str,
    weights: Any,
    state: Any,
    lesson: Lesson,
    probabilities: Float[Array, "members n"],
    rng: Array,
) -> tuple[Any, Any]:
    optimiser = _optimiser()

    def loss(own: Any, rows: Array) -> Array:
        picked, at = jax.tree.map(lambda leaf: leaf[rows], (lesson.shots, lesson.starts))
        return jnp.mean(jax.vmap(partial(_error, twin, key, lesson, own))(picked, at))

    def member(own: Any, state: Any, probability: Array, rng: Array) -> tuple[Any, Any]:
        rows = jax.random.choice(rng, len(probability), (_BATCH,), p=probability)
        gradient = jax.grad(loss)(own, rows)
        finite = jnp.all(jnp.array([jnp.isfinite(g).all() for g in jax.tree.leaves(gradient)]))
        gradient = jax.tree.map(lambda g: jnp.where(finite, g, 0.0), gradient)
        change, state = optimiser.update(gradient, state, own)
        return optax.apply_updates(own, change), state

    def step(carry: Any, rng: Array) -> tuple[Any, None]:
        keys = jax.random.split(rng, probabilities.shape[0])
        weights, state = carry
        return jax.vmap(member)(weights, state, probabilities, keys), None

    return jax.lax.scan(step, (weights, state), jax.random.split(rng, _CHUNK))[0]


@partial(jax.jit, static_argnums=(0, 1))
def _watched_loss(
    twin: Twin, key: str, weights: Any, lesson: Lesson, watched: Array
) -> Float[Array, " members"]:
    def member(own: Any) -> Array:
        errors = jax.vmap(partial(_error, twin, key, lesson, own))(lesson.shots, lesson.starts)
        return jnp.sum(jnp.where(watched, errors, 0.0)) / jnp.sum(watched)

    return jax.vmap(member)(weights)


def _error(
    twin: Twin,
    key: str,
    lesson: Lesson,
    own: Any,
    shot: Shots,
    start: tuple[Numbers, Numbers],
) -> Array:
    """
    Loss of one window under one member, as if the ensemble were that member alone. Errors that
    moving the start state could undo are projected out: otherwise start states fitted without the
    force would hide much of what it has to learn.
    """
    offset, basis = start
    alone = jax.tree.map(lambda leaf: leaf[None], own)
    tensors = {f"{key}.{name}": tree for name, tree in (lesson.scales | {"weights": alone}).items()}
    values = {**lesson.params, **tensors, f"{key}.share": jnp.ones(())}
    error = ((simulate(twin, values, shot, jnp.asarray(offset)) - shot.obs) / lesson.unit).ravel()
    error = jnp.where(jnp.isfinite(error), error, 0.0)
    size = jnp.abs(error - basis @ (basis.T @ error))
    small = jnp.minimum(size, _OUTLIER)
    return jnp.mean(0.5 * small**2 + _OUTLIER * (size - small))
