"""A check of whether a task can be learned."""

import math

import gymnasium
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_hds.data.wording import counted
from sb3_hds.errors import ParameterError
from sb3_hds.wrappers.checks.report import Report, name_of
from sb3_hds.wrappers.checks.task_sample import (
    Sample,
    explained_by,
    is_missing,
    knows_last_action,
    of_action_alone,
    sampled,
)

_LARGE, _SMALL = 10.0, 0.01
_RARE = 0.01
_LISTED = 3
_HALF = 0.5
# Discount below which a reward hardly counts.
_FORGOTTEN = 0.05
_FAR = 100
# Minimum number of ends for a conclusion.
_FEWEST_ENDS = 3
# Minimum number of random steps.
_LEAST = 100


class TaskReport(Report):
    """What :func:`check_task` found."""


def check_task(
    env: gymnasium.Env, *, gamma: float = 0.99, n_steps: int = 2_000, seed: int = 0
) -> TaskReport:
    """
    Find properties that make a task needlessly hard to learn.

    Steps the environment with random actions and checks the scale of observations and rewards, the
    action space, constant or sparse rewards, rewards that depend on unobserved quantities (the last
    action, velocities), rewarded terminations, and the episode length relative to the discount. All
    numbers are those of random actions; a good policy may see others. The environment is reset and
    stepped, and not closed.

    :param env: wrapped as for the learner, but without ``VecNormalize``
    :param gamma: discount factor that will be used in training
    :param n_steps: at least 100
    :param seed: of initial states and actions
    :raises ParameterError: for anything but one environment, a discount outside [0, 1), or too few
        steps
    """
    if isinstance(env, VecEnv) or not isinstance(env, gymnasium.Env):
        raise ParameterError(
            f"check_task takes one gymnasium.Env, got {type(env).__name__}: pass one of the copies "
            "of a vectorised environment."
        )
    if not 0.0 <= gamma < 1.0:
        raise ParameterError(f"check_task(gamma={gamma!r}): gamma must be from 0 to below 1.")
    if n_steps < _LEAST:
        raise ParameterError(f"check_task(n_steps={n_steps!r}): at least {_LEAST} are needed.")
    sample = sampled(env, n_steps, seed)
    subject = (
        f"Task of {name_of(env)}: in {n_steps} random steps and "
        f"{counted(len(sample.lengths), 'full episode')}, gamma={gamma:g}"
    )
    return TaskReport(subject, _findings(env, sample, gamma), [])


def _observation_scale(sample: Sample) -> list[str]:
    """Networks are initialised for inputs of order 1."""
    broken = np.any(~np.isfinite(sample.obs), axis=0)
    if broken.any():
        return [
            f"Observation: {_listed(sample.names, np.asarray(broken))} was not "
            "finite. One such number turns all weights of a network into NaN. Bound it, or end "
            "the episode before."
        ]
    mean, std = np.abs(sample.obs.mean(0)), sample.obs.std(0)
    size = np.maximum(mean, std)
    large, small = size > _LARGE, (std > 0.0) & (size < _SMALL)
    if not (large | small).any():
        return []
    parts = [
        f"{_listed(sample.names, which)} {'has' if which.sum() == 1 else 'have'} a mean or "
        f"deviation of {_range(size[which])}"
        for which in (large, small)
        if which.any()
    ]
    return [
        f"Observation scale: under random actions {'; '.join(parts)}. Networks are initialised "
        "for inputs of order 1: large ones saturate them and dominate the others, small ones are "
        "ignored. Normalise: VecNormalize(env, norm_obs=True), `normalize: true` in the zoo's yml, "
        "or divide by known limits (gymnasium.wrappers.RescaleObservation)."
    ]


def _action_space(space: spaces.Space) -> list[str]:
    """Policies act in [-1, 1]."""
    if not isinstance(space, spaces.Box):
        return []
    if not np.isfinite([space.low, space.high]).all():
        return [
            f"Action space: {_bounds(space)} is not bounded. SAC and its relatives refuse it, "
            "since they map [-1, 1] to the limits; PPO explores with a standard deviation of one "
            "unit around 0. Set the limits of the actuators."
        ]
    if np.allclose(space.low, -1.0) and np.allclose(space.high, 1.0):
        return []
    return [
        f"Action space: {_bounds(space)} instead of [-1, 1]. SAC, TD3 and their relatives rescale "
        "by themselves; PPO and A2C do not: they start with a standard deviation of 1 around 0, "
        "which is too little for large limits and clipped for small ones. Rescale: "
        "gymnasium.wrappers.RescaleAction(env, -1.0, 1.0)."
    ]


def _reward_variety(sample: Sample) -> list[str]:
    """An informative reward varies."""
    inner = sample.rewards[~sample.terminated]
    if not len(inner):
        return []
    values, counts = np.unique(inner, return_counts=True)
    usual, others = values[counts.argmax()], len(inner) - counts.max()
    # If each step pays or costs the same until the end, the end is what is to be learned.
    if usual != 0.0 and sample.terminated.any():
        return []
    n = len(sample.rewards)
    if np.ptp(sample.rewards) == 0.0:
        return [
            f"Constant reward: each of {n} steps paid {usual:g}, so all actions are equally good. "
            "If there is another reward, random actions did not reach it, and a policy will do so "
            "by chance only: reward progress towards the goal, or start episodes near it."
        ]
    if of_action_alone(sample):
        return [
            f"Sparse reward: the rewards of {n} random steps depend on the action alone. A policy "
            "learns to minimise the action cost, and nothing about the task, until it finds "
            "another reward by chance. Reward progress towards the goal, start episodes near it, "
            "or explore further (gSDE, correlated noise)."
        ]
    n_other = others + int((sample.rewards[sample.terminated] != usual).sum())
    if n_other > _RARE * n:
        return []
    return [
        f"Sparse reward: {n - n_other} of {n} steps paid {usual:g}, only {n_other} something "
        "else. Until a policy finds these by chance, there is nothing to learn from. Reward "
        "progress towards the goal, start episodes near it, or use hindsight "
        "(HerReplayBuffer) where goals are part of the observation."
    ]


def _reward_scale(sample: Sample, gamma: float) -> list[str]:
    """Critics regress values, which are rewards times the horizon."""
    size = float(np.sqrt(np.mean(sample.rewards**2)))
    if size == 0.0 or _SMALL <= size <= _LARGE:
        return []
    value = size / (1.0 - gamma)
    return [
        f"Reward scale: the root mean square of a step's reward is {size:.3g}, so values are of "
        f"order {value:.3g} with gamma={gamma:g}. Critics start near 0 and approach them in steps "
        "of a fixed size; an entropy bonus is relative to them. Scale rewards to order 1: "
        "VecNormalize(env, norm_reward=True), or gymnasium.wrappers.TransformReward."
    ]


def _missing_state(sample: Sample) -> list[str]:
    """Rewards that depend on unobserved quantities."""
    found = explained_by(sample)
    if found is None or not np.isfinite(sample.obs).all():
        return []
    alone, with_action, with_obs = found
    problems = []
    if is_missing(alone, with_action) and not knows_last_action(sample):
        problems.append(
            f"Last action: observation and action leave {alone:.0%} of the reward's variance "
            f"unexplained, with the previous action {with_action:.0%}. The reward depends on "
            "changes of the action, but the observation does not contain the previous one: the "
            "same state and action have different rewards. Append the last action to the "
            "observation."
        )
    elif is_missing(alone, with_obs):
        problems.append(
            f"Velocity: observation and action leave {alone:.0%} of the reward's variance "
            f"unexplained, with the previous observation {with_obs:.0%}. The reward depends on "
            "motion that a single observation does not show. Observe velocities, or stack "
            "observations (gymnasium.wrappers.FrameStackObservation, VecFrameStack)."
        )
    return problems


def _rewarded_end(sample: Sample, gamma: float) -> list[str]:
    """If each step costs, termination is rewarded."""
    ends = np.flatnonzero(sample.terminated)
    if len(ends) < _FEWEST_ENDS or sample.success[ends].mean() > _HALF:
        return []
    living, last = float(sample.rewards[~sample.terminated].mean()), sample.rewards[ends].mean()
    horizon = sample.limit or math.inf
    staying = living * (1.0 - gamma**horizon) / (1.0 - gamma)
    if living >= 0.0 or last <= staying:
        return []
    return [
        f"Termination pays: a step costs {-living:.3g} on average and staying therefore "
        f"{-staying:.3g} with gamma={gamma:g}, while the last step of {len(ends)} episodes that "
        f"terminated paid {last:.3g}, and nothing after it. Unless staying can be made cheaper, "
        "the best policy ends soon. If the end is a failure, pay for each step alive, or make "
        "the end cost more than staying. If it is the goal, mark it: info['is_success']=True."
    ]


def _horizon(sample: Sample, gamma: float) -> list[str]:
    """The horizon of the discount relative to the length of episodes."""
    ahead = 1.0 / (1.0 - gamma)
    if not len(sample.lengths) and sample.limit is None:
        return [
            f"Episode length: no episode ended in {counted(len(sample.rewards), 'step')}, and no "
            "time limit is known. A policy sees new initial states only after an end, and "
            "returns are logged only then. Add a limit: gymnasium.wrappers.TimeLimit(env, "
            "max_episode_steps=...)."
        ]
    problems = []
    cut = float(sample.limit or math.inf)
    length = float(sample.lengths.mean()) if len(sample.lengths) else cut
    if sample.truncated.any():
        cut = float((sample.age[sample.truncated] + 1).mean())
    if 1.0 - gamma**cut < _HALF:
        enough = math.ceil(math.log(_HALF) / math.log(gamma))
        problems.append(
            f"Episode length: episodes are truncated after {cut:.0f} steps, which carry only "
            f"{1.0 - gamma**cut:.0%} of the weight of gamma={gamma:g}; the rest of each value is "
            "bootstrapped, which is right only if time-outs are reported as truncations "
            f"(check_truncation). Make episodes of {enough} steps or more, or lower gamma."
        )
    elif length > _FAR * ahead:
        problems.append(
            f"Episode length: episodes have {length:.0f} steps and gamma={gamma:g} looks about "
            f"{ahead:.0f} ahead: later rewards do not affect the current action. If they matter, "
            "raise gamma, or make control steps longer."
        )
    return problems + _late(sample, gamma)


def _late(sample: Sample, gamma: float) -> list[str]:
    """Rewards that come only long after the start."""
    values, counts = np.unique(sample.rewards, return_counts=True)
    special = sample.rewards != values[counts.argmax()]
    if not special.any() or special.mean() > 5 * _RARE:
        return []
    delay = float(sample.age[special].mean())
    weight = gamma**delay
    if weight >= _FORGOTTEN:
        return []
    return [
        f"Late reward: rewards that differ from the usual {values[counts.argmax()]:g} come "
        f"{delay:.0f} steps after the start on average, where gamma={gamma:g} leaves "
        f"{weight:.1%} of them. Early actions hardly affect the return. Raise gamma to "
        f"{_HALF ** (1.0 / delay):.4f} or more, or reward progress on the way."
    ]


def _findings(env: gymnasium.Env, sample: Sample, gamma: float) -> list[str]:
    """:return: the problems of all checks, one paragraph each"""
    inputs = [*_observation_scale(sample), *_action_space(env.action_space)]
    if not np.isfinite(sample.rewards).all():
        return [
            *inputs,
            "Reward: it was not finite. One such number ruins the critics. Bound it, or end the "
            "episode before.",
        ]
    return [
        *inputs,
        *_reward_variety(sample),
        *_reward_scale(sample, gamma),
        *_missing_state(sample),
        *_rewarded_end(sample, gamma),
        *_horizon(sample, gamma),
    ]


def _listed(names: list[str], which: np.ndarray) -> str:
    chosen = [name for name, one in zip(names, which, strict=True) if one]
    more = f" and {len(chosen) - _LISTED} more" if len(chosen) > _LISTED else ""
    return ", ".join(chosen[:_LISTED]) + more


def _range(sizes: np.ndarray) -> str:
    low, high = f"{sizes.min():.2g}", f"{sizes.max():.2g}"
    return low if low == high else f"{low} to {high}"


def _bounds(space: spaces.Box) -> str:
    low, high = np.unique(space.low), np.unique(space.high)
    if len(low) == len(high) == 1:
        return f"limits are [{low[0]:g}, {high[0]:g}]"
    return f"limits are from {low[0]:g} to {high[-1]:g}, and differ between actions"
