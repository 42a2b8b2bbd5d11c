"""Consistency checks of a twin as a mechanical system."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from sb3_hds.core import AnalyticTwin, Params, State, Twin
from sb3_hds.core.contract import check_layer, check_methods
from sb3_hds.core.numerics.compilation import QUICKEST_COMPILATION
from sb3_hds.core.twin import layers_of, plant_of
from sb3_hds.errors import TwinError
from sb3_hds.twins import registry
from sb3_hds.twins.check_result import CheckItem, TwinCheck, outcomes
from sb3_hds.twins.mechanics import ROUNDING, Points, check_mechanics, precision

_N_STARTS, _N_STEPS = 16, 20
_N_POINTS = 64  # at which the terms of the equation of motion are compared
_OWN, _GENERIC = 0, 1  # the first two variants of the parameters
_TINY = 1e-300
_REST = "everything else, before that is fixed"
# In the order in which they are reported: later ones use what earlier ones return.
_METHODS = (
    "step", "observe", "infer", "observe(infer(obs))", "terminated", "reward", "planning_reward"
)  # fmt: skip


def check(twin: Twin | type[Twin] | str, *, seed: int = 0) -> TwinCheck:
    r"""
    Check that a twin is finite, consistent and, where it has a mass matrix, mechanical.

    - shapes and dtypes of what every method returns, in single and double precision
    - states, observations, rewards and their derivatives are finite, at the bounds of the
      parameters too
    - ``infer`` is the inverse of ``observe``
    - each parameter and each command has an effect
    - the mass matrix is symmetric and positive definite
    - gravity and springs have a potential: :math:`\partial c(q, 0) / \partial q` is symmetric
    - inertial forces do no work, :math:`v^T (\tfrac12 \dot M v - c(q, v) + c(q, 0)) = 0`; with
      damping, the left side is negative
    - without actuators, the energy after :meth:`step` decreases by the work of damping, up to an
      error that shrinks with the sub-step

    Everything is evaluated in double precision at random states, commands and parameters within a
    ``scale`` of the twin's own. Values of masses and lengths cannot be checked this way:
    ``verify_mirror`` compares with an environment, ``calibrate`` with data.

    Source: Spong, Hutchinson and Vidyasagar, *Robot Modeling and Control*, 2006, section 7.5
    (passivity), for potential and inertial forces.

    :param twin: a twin, its class, or its registered name
    :param seed: of all random numbers
    :raises NoTwinError: for a name that is not registered
    :raises TypeError: for anything else
    """
    if isinstance(twin, str):
        twin = registry.get(twin)
    made: Any = twin() if isinstance(twin, type) else twin
    if not isinstance(made, Twin):
        raise TypeError(f"twins.check takes a twin, its class or its name, got {twin!r}.")
    contract = _contract(made)
    if not contract.ok:
        return TwinCheck(made.name, (contract,), _REST)
    with jax.enable_x64(True):
        samples = _sampled(made, seed)
        finite = _finite(samples)
        if not finite.ok:
            return TwinCheck(made.name, (contract, finite), _REST)
        items = [contract, finite, _inverse(made, samples), _parameters(made, samples)]
        items += [_commands(made, samples)] if made.actuators else []
        plant = plant_of(made)
        if not isinstance(plant, AnalyticTwin):
            return TwinCheck(made.name, tuple(items), "energy, without a mass matrix")
        items += check_mechanics(plant, _points(plant, samples, seed))
    return TwinCheck(made.name, tuple(items))


# --- motion


class _Samples(NamedTuple):
    """
    Motions under random commands for several variants of the parameters. The first variant has the
    twin's own values, the second random ones; each of the others changes one parameter or command
    of the second.

    :param names: of the variants
    :param params: leading axis ``n_variants``
    :param states: after each step, the start first: ``(n_variants, n_starts, n_steps + 1, ...)``
    :param returned: values of each method after each step
    :param smooth: whether the derivatives of each method are finite there
    """

    names: tuple[str, ...]
    params: Params
    states: State
    returned: dict[str, np.ndarray]
    smooth: dict[str, Any]


def _sampled(twin: Twin, seed: int) -> _Samples:
    rng = np.random.default_rng(seed)
    own = {name: float(value) for name, value in twin.values.items()}
    generic = {name: _moved(twin, name, own[name]) for name in own}
    variants = {"own": own, "generic": generic}
    for name, parameter in twin.parameters.items():
        variants[f"value {name}"] = generic | {name: _moved(twin, name, generic[name])}
        for bound in (parameter.lower, parameter.upper):
            if np.isfinite(bound):
                variants[f"{name} = {bound:g}"] = generic | {name: bound}
    low, high = _limits(twin)
    shape = (_N_STARTS, _N_STEPS, len(low))
    actions = low + rng.uniform(size=shape) * (high - low)
    actions_of = [actions] * len(variants)
    for i, actuator in enumerate(twin.actuators):
        variants[f"command {actuator.name}"] = generic
        # Shifted by half the range, within the limits.
        shifted = actions[..., i] + 0.5 * (high - low)[i]
        actions_of.append(actions.copy())
        actions_of[-1][..., i] = np.where(shifted > high[i], shifted - (high - low)[i], shifted)
    params = {name: np.array([values[name] for values in variants.values()]) for name in own}
    seeds = rng.integers(2**31, size=_N_STARTS)
    return _Samples(tuple(variants), params, *_motions(twin, seeds, params, np.stack(actions_of)))


def _motions(twin: Twin, seeds: np.ndarray, params: Params, actions: np.ndarray) -> Any:
    """:return: for each step, states, values of methods, and whether derivatives are finite"""

    def outcome(state: State, action: Array, params: Params) -> tuple[State, dict[str, Array]]:
        params = {**params, **twin.tensors}
        after = twin.step(state, action, params)
        obs = twin.observe(after, params)
        inferred = twin.infer(obs, params)
        return after, {
            "observe": obs,
            "infer": jnp.concatenate([inferred.q, inferred.v]),
            "observe(infer(obs))": twin.observe(inferred, params),
            "reward": twin.reward(state, action, after, params),
            "planning_reward": twin.planning_reward(state, action, after, params),
        }

    def motion(seed: Array, actions: Array, params: Params) -> Any:
        def step(state: State, action: Array) -> Any:
            at = (state, action, params)
            (after, returned), slopes = jax.jvp(outcome, at, jax.tree.map(jnp.ones_like, at))
            over = 1.0 * twin.terminated(after, {**params, **twin.tensors})
            smooth = jax.tree.map(_all_finite, {"step": slopes[0], **slopes[1]})
            return after, (after, returned | {"terminated": over}, smooth)

        start = twin.initial(jax.random.key(seed), {**params, **twin.tensors})
        start = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), start)
        _, (states, *rest) = jax.lax.scan(step, start, actions)
        states = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, states)
        return states, *rest

    # One axis for variants and starts, because two take twice as long to compile.
    n_variants, n_starts = actions.shape[:2]
    flat = (
        np.tile(seeds, n_variants),
        actions.reshape(n_variants * n_starts, *actions.shape[2:]),
        {name: np.repeat(values, n_starts) for name, values in params.items()},
    )
    found = jax.jit(jax.vmap(motion), compiler_options=QUICKEST_COMPILATION)(*flat)
    return jax.tree.map(
        lambda leaf: np.asarray(leaf).reshape(n_variants, n_starts, *leaf.shape[1:]), found
    )


def _all_finite(values: Array) -> Array:
    return jnp.isfinite(values).all()


def _moved(twin: Twin, name: str, value: float) -> float:
    """:return: another value within the bounds, half a typical deviation away if possible"""
    parameter = twin.parameters[name]
    for move in (0.5, -0.5, 0.05, -0.05):
        if parameter.lower <= (moved := value + move * parameter.scale) <= parameter.upper:
            return moved
    return value


def _limits(twin: Twin) -> tuple[np.ndarray, np.ndarray]:
    """Limits of commands; infinite ones are replaced by typical forces, or 1."""
    size = max(twin.typical_forces(), default=0.0) or 1.0
    low, high = np.array([(a.low, a.high) for a in twin.actuators], float).reshape(-1, 2).T
    return (
        np.where(np.isfinite(low), low, np.where(np.isfinite(high), high - size, -size)),
        np.where(np.isfinite(high), high, np.where(np.isfinite(low), low + size, size)),
    )


# --- checks of any twin


def _contract(twin: Twin) -> CheckItem:
    passed, failed = outcomes("shapes and dtypes")
    try:
        check_methods(twin)
        for layer in reversed(list(layers_of(twin))):
            check_layer(layer)
    except TwinError as error:
        return failed(str(error))
    return passed("what every method returns, in single and double precision")


def _finite(samples: _Samples) -> CheckItem:
    passed, failed = outcomes("finite")
    values = {"step": np.concatenate(samples.states[:2], -1)[:, :, 1:], **samples.returned}
    values = {method: values[method] for method in _METHODS}
    for variant, label in enumerate(samples.names):
        # One step at a bound: motions may be too fast there for the twin's sub-step.
        n_steps = 1 if " = " in label else _N_STEPS
        for method, found in values.items():
            bad = ~np.isfinite(found[variant, :, :n_steps]).reshape(_N_STARTS, n_steps, -1)
            if bad.any():
                after = int(bad.any((0, 2)).argmax()) + 1
                where = f"with {label}" if n_steps == 1 else f"with {_variant_in_words(label)}"
                return failed(
                    f"{method} is not finite after {after} of {_N_STEPS} steps {where}",
                    f"Move the bound of {label.partition(' = ')[0]} to where the twin still works."
                    if n_steps == 1
                    else "Look for a division by zero or a root, or take more sub-steps.",
                )
    steep = [
        method
        for method in _METHODS
        if not all(
            leaf[[_OWN, _GENERIC]].all() for leaf in jax.tree.leaves(samples.smooth.get(method))
        )
    ]
    if steep:
        return failed(
            f"the derivative of {steep[0]} is not finite at a state that is visited",
            "A root or a norm has none at zero: write sqrt(x**2 + 1e-12), or jnp.where before it.",
        )
    return passed(
        f"{_N_STARTS} motions of {_N_STEPS} steps under random commands, their derivatives, and a "
        "step with each parameter at its bounds",
    )


def _variant_in_words(variant: str) -> str:
    words = {"own": "the twin's own values", "generic": "values within a scale of its own"}
    return words.get(variant, f"another {variant.partition(' ')[2]}")


def _inverse(twin: Twin, samples: _Samples) -> CheckItem:
    passed, failed = outcomes("infer inverts observe")
    obs, again, inferred = (
        samples.returned[key][_GENERIC].reshape(_N_STARTS * _N_STEPS, -1)
        for key in ("observe", "observe(infer(obs))", "infer")
    )
    size = np.maximum(np.abs(obs).max(0), _TINY)
    error = (np.abs(again - obs) / size).max(0)
    worst = int(error.argmax())
    if not error.max() < ROUNDING:
        return failed(
            f"observe(infer(obs)) differs from obs in '{twin.channels[worst].name}' by "
            f"{error[worst]:.1%} of its largest value",
            "infer has to put each channel back where observe took it from.",
        )
    moved = [np.asarray(part[_GENERIC, :, 1:]).reshape(len(obs), -1) for part in samples.states[:2]]
    parts = zip(
        ("position", "velocity"), moved, np.split(inferred, [moved[0].shape[1]], 1), strict=True
    )
    lost = [
        f"{what} of {name}"
        for what, before, after in parts
        for name, angle, b, a in zip(*_coordinates(twin, before), before.T, after.T, strict=True)
        if _largest(a - b, what == "position" and angle) > ROUNDING * np.abs(b).max()
    ]
    found = f"observe(infer(obs)) equals obs {precision(error.max())}"
    return passed(f"{found}; infer does not recover {', '.join(lost)}" if lost else found)


def _coordinates(twin: Twin, part: np.ndarray) -> tuple[list[str], list[bool]]:
    """:return: names of the columns, and which are angles; those of a free body have numbers"""
    if part.shape[1] != len(twin.joints):
        return [f"coordinate {i}" for i in range(part.shape[1])], [False] * part.shape[1]
    return [j.name for j in twin.joints], [j.unit == "rad" for j in twin.joints]


def _largest(change: np.ndarray, angle: bool) -> float:
    """The largest absolute change; of an angle, modulo full turns."""
    turns = np.round(change / (2.0 * np.pi)) if angle else 0.0
    return float(np.abs(change - 2.0 * np.pi * turns).max())


def _parameters(twin: Twin, samples: _Samples) -> CheckItem:
    passed, failed = outcomes("parameters")
    effects = {parameter: _effect(samples, f"value {parameter}") for parameter in twin.parameters}
    outside = [n for n, p in twin.parameters.items() if not p.lower <= twin.values[n] <= p.upper]
    if outside:
        return failed(f"out of bounds: {', '.join(outside)}", "Set other values.")
    idle = [parameter for parameter, effect in effects.items() if not effect > ROUNDING]
    if idle:
        return failed(
            f"without effect on motion, observation and reward: {', '.join(idle)}",
            "Methods take values from params, never from self. Leave out what nothing uses.",
        )
    return passed(f"within their bounds, and each has an effect{_least(effects)}")


def _commands(twin: Twin, samples: _Samples) -> CheckItem:
    passed, failed = outcomes("commands")
    effects = {a.name: _effect(samples, f"command {a.name}") for a in twin.actuators}
    idle = [actuator for actuator, effect in effects.items() if not effect > ROUNDING]
    if idle:
        return failed(
            f"without effect on the motion: {', '.join(idle)}",
            "Use each entry of the action in actuate, within its limits low and high.",
        )
    return passed(f"each has an effect{_least(effects)}")


def _least(effects: dict[str, float]) -> str:
    if not effects:
        return ""
    name = min(effects, key=lambda name: effects[name])
    return f" (least: {name}, {min(effects[name], 1.0):.0e} of what it acts on)"


def _effect(samples: _Samples, variant: str) -> float:
    """The largest change relative to the second variant, as a share of the values' size."""
    i = samples.names.index(variant)
    moved = np.concatenate(samples.states[:2], -1)
    compared = [moved, *samples.returned.values()] if variant.startswith("value") else [moved]
    found = 0.0
    for values in compared:
        values = values.reshape(*values.shape[:3], -1)
        size = np.abs(values[[i, _GENERIC]]).max((0, 1, 2))
        change = np.abs(values[i] - values[_GENERIC]).max((0, 1))
        found = max(found, float(np.max(change / np.maximum(size, _TINY), initial=0.0)))
    return found


def _points(plant: AnalyticTwin, samples: _Samples, seed: int) -> Points:
    """Visited positions with hinges rotated at random, and velocities of the visited size."""
    rng = np.random.default_rng(seed + 1)
    params = {}
    for name, parameter in plant.parameters.items():
        own = float(samples.params[name][_OWN])
        drawn = own + parameter.scale * rng.uniform(-1.0, 1.0, _N_POINTS)
        params[name] = np.clip(drawn, parameter.lower, parameter.upper)
    dof = len(plant.joints)
    q, v = (part[: _GENERIC + 1].reshape(-1, dof) for part in samples.states[:2])
    rotary = np.array([joint.unit == "rad" for joint in plant.joints], float)
    q = rng.choice(q, _N_POINTS) + rotary * rng.uniform(-np.pi, np.pi, (_N_POINTS, dof))
    speeds = np.sqrt(np.mean(v**2, 0))
    speeds = np.where(speeds > 0.0, speeds, 1.0)
    return Points(params, q, speeds * rng.standard_normal((_N_POINTS, dof)))
