"""A check of whether a task can be learned."""

import gymnasium
from stable_baselines3.common.vec_env import VecEnv

from sb3_hds.errors import ParameterError
from sb3_hds.wrappers.checks.report import Report, counted, name_of
from sb3_hds.wrappers.checks.task_findings import findings
from sb3_hds.wrappers.checks.task_sample import sampled

_FEWEST = 100


class TaskReport(Report):
    """What :func:`check_task` found."""


def check_task(
    env: gymnasium.Env, *, gamma: float = 0.99, n_steps: int = 2_000, seed: int = 0
) -> TaskReport:
    """
    Look for properties that make a task needlessly hard to learn.

    Steps the environment with random actions and looks at the scale of observations and rewards,
    the action space, constant or sparse rewards, rewards that depend on unobserved quantities
    (the last action, velocities), rewarded terminations, and the length of episodes against the
    discount. All numbers are those of random actions; good policies may see others. The environment
    is reset and stepped, and not closed.

    :param env: wrapped as for the learner, but without ``VecNormalize``
    :param gamma: discount per step that it will be learned with
    :param n_steps: at least 100
    :param seed: of starts and actions
    :raises ParameterError: for anything but one environment, a discount that is not from 0 to below
        1, or too few steps
    """
    if isinstance(env, VecEnv) or not isinstance(env, gymnasium.Env):
        raise ParameterError(
            f"check_task takes one gymnasium.Env, got {type(env).__name__}: pass one of the copies "
            "of a vectorised environment."
        )
    if not 0.0 <= gamma < 1.0:
        raise ParameterError(f"check_task(gamma={gamma!r}): gamma must be from 0 to below 1.")
    if n_steps < _FEWEST:
        raise ParameterError(f"check_task(n_steps={n_steps!r}): at least {_FEWEST} are needed.")
    sample = sampled(env, n_steps, seed)
    subject = (
        f"Task of {name_of(env)}: in {n_steps} random steps and "
        f"{counted(len(sample.lengths), 'whole episode')}, gamma={gamma:g}"
    )
    return TaskReport(subject, findings(env, sample, gamma), [])
