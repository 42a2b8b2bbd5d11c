"""From the arguments of a constructor to what an epoch reads."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from sb3_hds.algos.base.construct import schedule_of
from sb3_hds.algos.twin.normalization import view_of
from sb3_hds.algos.twin.state import Knobs, Settings
from sb3_hds.core import Twin

if TYPE_CHECKING:
    from sb3_hds.algos.twin.algorithm import TwinAlgorithm

# A plan looks this far ahead where the horizon is derived [s], within these numbers of steps.
_HORIZON = 0.6
_SHORTEST, _LONGEST = 12, 32
# How many horizons the policy is followed beyond the end of a plan, where that is derived.
_LOOKAHEAD = 5


def settings_of(model: "TwinAlgorithm", twin: Twin) -> Settings:
    """
    :param twin: to plan in; the horizon is derived from its time step, unless one was passed
    :return: what an epoch is compiled for
    """
    horizon = model.horizon or int(np.clip(round(_HORIZON / twin.dt), _SHORTEST, _LONGEST))
    return Settings(
        twin=twin,
        actor=model.policy.actor_network,
        value=model.policy.value_network,
        n_rollouts=model.n_rollouts,
        horizon=horizon,
        lookahead=_LOOKAHEAD * horizon if model.lookahead is None else model.lookahead,
        advance=(horizon + 1) // 2 if model.reset_share < 1.0 else 0,
        planner=model.planner or ("first_order" if model.order == 1 else "ilqr"),
        n_iterations=model.n_iterations,
        n_step_sizes=model.n_step_sizes,
        n_candidates=model.n_random_plans,
        random_share=model.random_share,
        discount=model.gamma,
        terminal_value=model.terminal_value,
        shift_ends=model.shift_ends,
        plan_memory=model.plan_memory,
        n_learned=max(1, round(model.learned_share * horizon)),
        batch_size=model.batch_size,
        squared_error=model.loss == "squared",
        max_grad_norm=model.policy.max_grad_norm,
        annealed=model.temperature > 0.0,
        adapt_scales=model.adapt_scales,
    )


def knobs_of(model: "TwinAlgorithm", twin: Twin, remaining: float, gradient_steps: int) -> Knobs:
    """
    :param remaining: from 1 to 0 over the epochs of a training, for the schedules
    :return: what this epoch works with, without compiling again
    """
    n_epochs = int(model.policy.progress.n_epochs)
    rate = value_rate = model.lr_schedule(remaining)
    if model.value_learning_rate is not None:
        value_rate = schedule_of(model.value_learning_rate)(remaining)
    visited, relabel = visited_states(model, len(twin.channels))
    return Knobs(
        params=twin.params,
        varied=model.varied(twin),
        learning_rate=rate,
        value_learning_rate=value_rate,
        noise=model.exploration_noise * model.exploration_decay**n_epochs,
        temperature=model.temperature * model.temperature_decay**n_epochs,
        reset_share=model.reset_share,
        gain_weight=model.gain_weight,
        sensitivity_weight=model.sensitivity_weight,
        averaging=model.averaging,
        gradient_steps=gradient_steps,
        visited=visited,
        relabel=relabel,
        view=view_of(model.get_vec_normalize_env(), len(twin.channels)),
    )


def visited_states(model: "TwinAlgorithm", n_obs: int) -> tuple[jax.Array, jax.Array]:
    """
    Observations of the real environment to plan from, drawn from the replay buffer.

    :return: them, shape ``(n_rollouts, n_obs)``, and which rollouts start there, shape
        ``(n_rollouts,)``
    """
    buffer, n = model.replay_buffer, model.n_rollouts
    count = round(model.relabel_share * n)
    visited = np.zeros((n, n_obs), np.float32)
    if buffer is None or buffer.size() == 0:
        count = 0
    elif count:
        steps = np.random.randint(buffer.size(), size=count)
        copies = np.random.randint(buffer.n_envs, size=count)
        visited[:count] = buffer.observations[steps, copies].reshape(count, n_obs)
    return jnp.asarray(visited), jnp.arange(n) < count
