"""The twin that an algorithm plans in: choice, checks, effects, and observations as it has them."""

import warnings
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecNormalize

from sb3_hds import effects, twins
from sb3_hds.algos.base.checks import in_one_line
from sb3_hds.algos.base.files import from_state_dict, to_state_dict
from sb3_hds.algos.twin.policy import Normalization, unclipped
from sb3_hds.core import Effect, Twin
from sb3_hds.core.twin import plant_of
from sb3_hds.errors import EnvironmentMismatchError, NoTwinError, RewardError
from sb3_hds.planning import Problem, best_of_random

# Rollouts and steps for the first statistics of ``VecNormalize``.
_N_ROLLOUTS, _N_STEPS = 64, 50


def check_twin_observes(space: spaces.Space) -> None:
    """:raises EnvironmentMismatchError: for anything but a Box with one axis"""
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise EnvironmentMismatchError(
            f"A twin observes a Box with one axis, and this environment observes {space}. Use one "
            "that has a twin (sb3_hds.twins.all_ids() lists them), or make your own of its state."
        )


def check_reward(twin: Twin) -> None:
    """:raises RewardError: if the twin has no reward with a gradient and no planning reward"""
    base = plant_of(twin)
    surrogate = type(base).planning_reward is not Twin.planning_reward
    if not surrogate and type(base).reward is Twin.reward:
        raise RewardError(
            f"{twin.name} has no reward: it simulates a system without a task. Implement `reward`."
        )
    if not surrogate and not base.reward_has_gradient:
        raise RewardError(
            f"The reward of {twin.name} is flat almost everywhere, so its gradient is zero. "
            "Implement `planning_reward`: a smooth surrogate with the same maximum."
        )


def twin_given(twin: Any) -> Twin | None:
    """
    :param twin: a twin, its name, or None
    :return: the twin, or None
    :raises NoTwinError: for a name that is not registered
    :raises TypeError: for anything else
    """
    if twin is None or isinstance(twin, Twin):
        return twin
    if isinstance(twin, str):
        return twins.make(twin)
    raise TypeError(
        f"twin={in_one_line(twin)}: twin must be a twin, as from twins.make('Pendulum'), its name, "
        "or None for that of the environment."
    )


def require_twin(twin: Twin | None, spec: dict[str, Any] | None) -> Twin:
    """
    :param spec: of a saved twin that is not registered here
    :return: the twin
    :raises NoTwinError: if there is none
    """
    if twin is not None:
        return twin
    way_out = "" if spec else "Set an environment that has one (set_env). "
    raise NoTwinError(
        f"This model has no twin to plan in. {way_out}"
        "Load it with one: load(path, env=env, twin=...)."
    )


def twin_from_spec(spec: dict[str, Any]) -> Twin | None:
    """:return: the twin that a file describes, or None, with a warning, if it is not registered"""
    try:
        return twins.from_spec(spec, effects.KNOWN)
    except NoTwinError as error:
        warnings.warn(
            f"The model can predict but not train, because its twin '{spec['twin']}' is not "
            f"registered here. Register it, or load with twin=... ({str(error).splitlines()[0]})"
        )
        return None


def missing_effects(twin: Twin, wanted: Sequence[str | dict[str, Any]]) -> list[Effect]:
    """
    :param wanted: names of effects, each for all of its possible locations, or specs of effects
    :return: the effects that the twin does not have yet
    :raises EffectError: for a name that is not in the catalogue
    """
    found: list[Effect] = []
    for entry in wanted:
        if isinstance(entry, str):
            effect = effects.effect_named(entry, effects.KNOWN)
            found += [effect(place.name) for place in _places(twin)[effect.slot]]
        else:
            effect = effects.effect_named(entry["effect"], effects.KNOWN)
            options = entry.get("options", {})
            found.append(effect(entry["where"], **options, **entry["parameters"]))
    return [effect for effect in found if not _has(twin, effect)]


def nulls_of(attached: Sequence[Effect]) -> dict[str, float]:
    """
    :param attached: effects with the names of their locations
    :return: nominal values of their parameters, by full name
    """
    return {
        f"{effect.name}.{effect.where}.{name}": parameter.null
        for effect in attached
        for name, parameter in effect.parameters.items()
    }


def _has(twin: Twin, effect: Effect) -> bool:
    places = _places(twin)[effect.slot]
    where = places[effect.where].name if isinstance(effect.where, int) else effect.where
    return any(name.startswith(f"{effect.name}.{where}.") for name in twin.values)


def _places(twin: Twin) -> dict[str, Any]:
    return {"joint": twin.joints, "actuator": twin.actuators, "channel": twin.channels}


class LearnedTensors:
    """
    The learned arrays of a model's twin, as SB3 saves a network.

    :param model: whose ``twin`` has them
    """

    def __init__(self, model: Any) -> None:
        self._model = model

    def state_dict(self) -> dict[str, th.Tensor]:
        twin = self._model.twin
        return {} if twin is None else to_state_dict(dict(twin.tensors))

    def load_state_dict(self, state_dict: dict[str, th.Tensor], strict: bool = True) -> None:
        twin = self._model.twin
        if twin is not None and (twin.tensors or state_dict):
            tensors = from_state_dict(dict(twin.tensors), state_dict, strict)
            self._model.twin = twin.with_tensors(tensors)


def normalization_of(normalise: VecNormalize | None, n_obs: int) -> Normalization:
    """
    :param normalise: the environment's normalisation, if it has one
    :return: its effect on observations of the twin
    """
    if normalise is None or not normalise.norm_obs:
        return Normalization(jnp.zeros(n_obs), jnp.ones(n_obs), unclipped())
    statistics: Any = normalise.obs_rms
    scale = np.sqrt(statistics.var + normalise.epsilon)
    return Normalization(
        jnp.asarray(statistics.mean, jnp.float32),
        jnp.asarray(scale, jnp.float32),
        jnp.asarray(normalise.clip_obs, jnp.float32),
    )


def prepare_statistics(normalise: VecNormalize | None, twin: Twin, key: jax.Array) -> None:
    """
    Give a new ``VecNormalize`` the statistics of episodes in the twin. Otherwise, its scales would
    change after the pretraining of the policy.

    Frozen statistics, and those of more observations, do not change.

    :param normalise: changed in place
    """
    if normalise is None or not normalise.norm_obs or not normalise.training:
        return
    statistics: Any = normalise.obs_rms
    if statistics.count >= _N_ROLLOUTS * _N_STEPS:
        return
    problem = Problem(twin, twin.params)
    length = min(_N_STEPS, twin.max_episode_steps or _N_STEPS)

    def wander(k: jax.Array) -> tuple[jax.Array, jax.Array]:
        k_start, k_plan = jax.random.split(k)
        start = twin.initial(k_start, twin.params)
        plan = best_of_random(problem, start, k_plan, length, 1)
        return jax.vmap(problem.observe)(plan.states), plan.alive

    seen, alive = jax.jit(jax.vmap(wander))(jax.random.split(key, _N_ROLLOUTS))
    lived = np.asarray(seen, np.float64)[np.asarray(alive)]
    statistics.update(lived[np.isfinite(lived).all(1)])
