"""Step-by-step comparison of an environment and its twin."""

import functools
import math
import warnings

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from sb3_hds.core import Action, Obs, Params, Twin
from sb3_hds.envs.mirror import check_mirrors
from sb3_hds.errors import EnvironmentMismatchError

# Random steps after which hidden parts of a state, if there are any, differ from zero.
_STEPS_BEFORE = 5


def verify_mirror(
    env: gymnasium.Env, twin: Twin, steps: int = 20, tolerance: float = 1e-3, seed: int = 0
) -> float:
    """
    Check a twin against its environment, one step at a time, with random actions.

    Each step starts from the state that the twin infers from the environment's observation, so
    errors do not accumulate. The next observation and the reward are compared relative to
    ``1 + |value|``; a step that ends the episode in only one of them counts as an error of 1.

    :param env: the environment, wrapped or not; it is reset and stepped
    :param twin: supposed to mirror the environment
    :param steps: number of steps that are compared
    :param tolerance: largest error that passes. The default allows for rounding: observations are
        single precision, and a step may amplify their errors.
    :param seed: of the environment's resets and the actions
    :return: the largest error, or nan, with a warning, if one observation does not determine the
        state
    :raises EnvironmentMismatchError: if spaces differ, or an error exceeds the tolerance
    """
    check_mirrors(env, twin)
    with jax.enable_x64(True):
        if not _observation_determines_state(twin, seed):
            warnings.warn(
                f"One observation does not determine the state of {twin.name}, so its steps "
                "cannot be compared with the environment's. Compare them from known states."
            )
            return math.nan
        errors = _errors(env, twin, steps, seed)
    worst = max(errors, key=lambda name: errors[name])
    if not errors[worst] <= tolerance:
        raise EnvironmentMismatchError(
            f"{twin.name} disagrees with the environment: within {steps} steps the error in "
            f"'{worst}' reaches {errors[worst]:.2g}; the tolerance is {tolerance:.2g}. Compare its "
            "parameters and its time step with the environment's."
        )
    return errors[worst]


def _errors(env: gymnasium.Env, twin: Twin, steps: int, seed: int) -> dict[str, float]:
    """Largest error of each channel, of the reward and of the end of the episode, by name."""
    largest = dict.fromkeys([*(c.name for c in twin.channels), "reward", "terminated"], 0.0)
    generator = np.random.default_rng(seed)
    low, high = np.array([(a.low, a.high) for a in twin.actuators]).T
    predict = jax.jit(functools.partial(_predict, twin))
    obs, _ = env.reset(seed=seed)
    for _ in range(steps):
        action = generator.uniform(low, high).astype(env.action_space.dtype)
        known = (np.asarray(a, np.float64) for a in (obs, action))
        predicted = np.asarray(predict(*known, twin.params))
        obs, reward, terminated, truncated, _ = env.step(action)
        actual = np.array([*obs, float(reward), float(terminated)], np.float64)
        error = np.abs(predicted - actual) / (1.0 + np.abs(actual))
        error[-1] = abs(predicted[-1] - actual[-1])
        for name, e in zip(largest, error.tolist(), strict=True):
            largest[name] = e if math.isnan(e) else max(largest[name], e)
        if terminated or truncated:
            obs, _ = env.reset()
    return largest


def _predict(twin: Twin, obs: Obs, action: Action, params: Params) -> Array:
    """Next observation, reward and end of episode that the twin predicts, in one array."""
    before = twin.infer(obs, params)
    after = twin.step(before, action, params)
    reward = twin.reward(before, action, after, params)
    ended = twin.terminated(after, params)
    return jnp.concatenate([twin.observe(after, params), jnp.stack([reward, 1.0 * ended])])


def _observation_determines_state(twin: Twin, seed: int) -> bool:
    """Whether a step from the inferred state gives the same observation as from the true one."""
    params, generator = twin.params, np.random.default_rng(seed)
    low, high = np.array([(a.low, a.high) for a in twin.actuators]).T
    step, observe = jax.jit(twin.step), jax.jit(twin.observe)
    state = twin.initial(jax.random.key(seed), params)
    for _ in range(_STEPS_BEFORE):
        state = step(state, generator.uniform(low, high), params)
    action = generator.uniform(low, high)
    inferred = twin.infer(observe(state, params), params)
    there, guess = (observe(step(start, action, params), params) for start in (state, inferred))
    return bool(jnp.allclose(there, guess, rtol=1e-6, atol=1e-6))
