"""A check of whether time-outs reach the learner as truncations."""

import math
from collections import Counter
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv, VectorWrapper
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper

from sb3_hds.data.wording import counted
from sb3_hds.errors import ParameterError
from sb3_hds.wrappers.checks.ends_seen import Seen, ends_of_env, ends_of_vec_env, is_same
from sb3_hds.wrappers.checks.report import Report, name_of
from sb3_hds.wrappers.episodes import Limit, limits_of, own_limit, step_limit_of
from sb3_hds.wrappers.vec_env import GymnasiumVecEnv

# Steps to sample if no limit is known.
_DEFAULT_STEPS = 2_000
# Ends after the same number of steps are a limit if there are at least so many, and they are half
# of all ends, or outnumber those of any length in the last fifth before, and of any other length,
# by these factors.
_FEWEST = 3
_THAN_BEFORE, _THAN_ANY = 3.0, 1.5
# Attributes that hold the limit of a vectorised layer; single environments use the first.
_NAMES = ("_max_episode_steps", "max_episode_steps")
# Messages of Python if an environment has the interface of Gym before 0.26.
_OLD_SIGNS = ("values to unpack", "unexpected keyword argument 'seed'")


class TruncationReport(Report):
    """What :func:`check_truncation` found."""


def check_truncation(
    env: gymnasium.Env | VecEnv | VectorEnv, *, n_steps: int | None = None, seed: int = 0
) -> TruncationReport:
    r"""
    Check that time-outs reach the learner as truncations.

    A learner bootstraps the value of the last observation at a truncation, and uses 0 at a
    termination. A time limit reported as a termination silently biases values: those of a constant
    reward of 1 by a factor of :math:`1 / (1 - \gamma^n)` for a limit of ``n`` steps.

    Episodes are sampled with random actions. The meaning of an end cannot be observed, but ends
    that recur after the same number of steps are a time limit, unless observations contain the
    time. A limit around a shorter one, which never takes effect, is found in the stack of wrappers,
    or for copies in other processes from episode lengths. The environment is reset and stepped, and
    not closed.

    :param env: an environment, an SB3 ``VecEnv``, or a Gymnasium ``VectorEnv`` in any autoreset
        mode, wrapped as for the learner
    :param n_steps: at most; None: four episodes of the time limit in each copy, or 2,000
    :param seed: of initial states and actions
    :raises ParameterError: for anything else, or fewer than one step
    """
    if n_steps is not None and n_steps < 1:
        raise ParameterError(f"check_truncation(n_steps={n_steps}): at least one step is needed.")
    if isinstance(env, VectorEnv):
        problems, notes, seen = _of_vector_env(env, n_steps, seed)
    elif isinstance(env, VecEnv):
        problems, notes, seen = _of_vec_env(env, n_steps, seed)
    elif isinstance(env, gymnasium.Env):
        problems, notes, seen = _of_env(env, n_steps, seed)
    else:
        raise ParameterError(
            "check_truncation takes a gymnasium.Env, an SB3 VecEnv or a gymnasium.vector.VectorEnv,"
            f" got {type(env).__name__}."
        )
    return TruncationReport(_subject(env, seen), problems, notes)


def _of_env(env: gymnasium.Env, n_steps: int | None, seed: int) -> tuple[list, list, Seen]:
    limit = step_limit_of(env)
    try:
        seen = ends_of_env(env, n_steps or 4 * (limit or _DEFAULT_STEPS // 4), seed)
    except (ValueError, TypeError) as error:
        if not any(sign in str(error) for sign in _OLD_SIGNS):
            raise
        old = (
            f"{env}.step() or reset() does not return what Gymnasium's do ({error}). With a single "
            "'done', a time-out cannot be told from a failure. Return (obs, reward, terminated, "
            "truncated, info), and (obs, info) from reset(seed=..., options=...)."
        )
        return [old], [], Seen([], 0, False)
    problems = _only_in_info(seen) + _looks_like_a_limit(seen, limit)
    problems += _never_acts([limits_of(env)], env, seen) + _nothing_ended(seen)
    return problems, [] if problems else _unseen(seen, limit), seen


def _of_vec_env(env: VecEnv, n_steps: int | None, seed: int) -> tuple[list, list, Seen]:
    stacks, copies = _stacks(env)
    known = [min(map(_steps_of, stack)) for stack in stacks if stack]
    limit = max(filter(None, known or map(step_limit_of, copies)), default=None)
    seen = ends_of_vec_env(env, n_steps or env.num_envs * 4 * (limit or _DEFAULT_STEPS // 4), seed)
    problems = _missing_keys(seen) + _lost_observations(env, seen)
    if _marks_time_outs(seen):
        problems += _looks_like_a_limit(seen, limit) + _never_acts(stacks, env, seen)
    problems += _nothing_ended(seen)
    return problems, [] if problems else _unseen(seen, limit), seen


def _of_vector_env(env: VectorEnv, n_steps: int | None, seed: int) -> tuple[list, list, Seen]:
    try:
        adapted = GymnasiumVecEnv(env)
        problems, notes, seen = _of_vec_env(adapted, n_steps, seed)
    except (ParameterError, RuntimeError) as error:
        return [str(error)], [], Seen([], 0, False)
    if adapted.autoreset_mode is AutoresetMode.NEXT_STEP:
        notes.append(
            "In NEXT_STEP mode the step after an end ignores the action and is no transition. "
            "GymnasiumVecEnv(env) leaves it out; a learner of your own must, too."
        )
    return problems, notes, seen


def _only_in_info(seen: Seen) -> list[str]:
    n = sum(end.terminated and bool(end.info.get("TimeLimit.truncated")) for end in seen.ends)
    if not n:
        return []
    return [
        f"{counted(n, 'time-out')} of {counted(len(seen.ends), 'end')} came only as "
        "info['TimeLimit.truncated'], and step() returned terminated=True. SB3 sets this entry "
        "itself from what step() returns, so the time-out counts as a failure. Return "
        "truncated=True and terminated=False."
    ]


def _looks_like_a_limit(seen: Seen, limit: int | None) -> list[str]:
    """Terminations that recur after the same number of steps."""
    longest = max((end.length for end in seen.ends), default=0)
    lengths = Counter(end.length for end in seen.ends if end.terminated)
    n, at_end = lengths[longest], [end for end in seen.ends if end.length == longest]
    often = n >= _FEWEST and (2 * n >= lengths.total() or _stands_out(lengths, longest))
    # An episode of one step has no time to run out.
    if longest < 2 or not (often or (longest == limit and n > 1)) or seen.clock:
        return []
    if not all(end.terminated for end in at_end):
        return []
    return [
        f"{n} of {counted(len(seen.ends), 'episode')} ended as terminations after exactly "
        f"{longest} steps. That looks like a time limit: the learner will use 0 as the "
        "value of states that have another. Return truncated=True, terminated=False there, or use "
        f"sb3_hds.wrappers.InfiniteHorizon(env, max_episode_steps={longest}). If the task "
        "really ends then, add the time to observations: sb3_hds.wrappers.TimeAware."
    ]


def _never_acts(stacks: list[list[Limit]], env: Any, seen: Seen) -> list[str]:
    """A limit around a shorter one, which ends every episode first."""
    found = [pair for stack in stacks if (pair := _outrun(stack)) is not None]
    if found:
        outer, inner = found[0]
        where = f" (in {len(found)} of {len(stacks)} copies)" if len(stacks) > 1 else ""
        what = (
            f"The limit of {outer} never takes effect{where}: "
            f"that of {inner} inside it comes first."
        )
    else:
        outer = min((stack[0] for stack in stacks if stack), key=_steps_of, default=None)
        cut = Counter(end.length for end in seen.ends if not end.terminated)
        longest = max((end.length for end in seen.ends), default=0)
        n = cut[longest]
        if outer is None or longest >= outer.steps or n < _FEWEST or 2 * n < cut.total():
            return []
        what = (
            f"{n} of {counted(len(seen.ends), 'episode')} were truncated after exactly {longest} "
            f"steps by an inner layer: the limit of {outer} never takes effect."
        )
    spec = getattr(env, "spec", None)
    made = f"gymnasium.make('{spec.id}'" if spec is not None else "gymnasium.make(id"
    return [
        f"{what} Episodes are shorter than requested. Set the limit where the environment is "
        f"made, as {made}, max_episode_steps={outer.steps}), or remove one of them."
    ]


def _outrun(stack: list[Limit]) -> tuple[Limit, Limit] | None:
    """:return: the first limit around a shorter one, and the shortest one inside it"""
    for i, outer in enumerate(stack):
        inner = min(stack[i:], key=_steps_of)
        if inner.steps < outer.steps:
            return outer, inner
    return None


def _steps_of(limit: Limit) -> int:
    return limit.steps


def _stands_out(lengths: Counter, longest: int) -> bool:
    """Whether far more episodes have the longest length than failures alone would explain."""
    n, earlier = lengths[longest], {k: m for k, m in lengths.items() if k < longest}
    before = max((m for k, m in earlier.items() if k >= 0.8 * longest), default=0)
    return n >= max(_THAN_BEFORE * before, _THAN_ANY * max(earlier.values(), default=0))


def _marks_time_outs(seen: Seen) -> bool:
    """Whether all ends, or at least the time-outs, are marked; SB3 reads a missing key as False."""
    flags = [end.info.get("TimeLimit.truncated") for end in seen.ends]
    return any(flags) or None not in flags


def _missing_keys(seen: Seen) -> list[str]:
    problems = []
    n = sum("TimeLimit.truncated" not in end.info for end in seen.ends)
    if n and not _marks_time_outs(seen):
        problems.append(
            f"In {n} of {counted(len(seen.ends), 'end')}, infos[i] had no 'TimeLimit.truncated'. "
            "SB3 treats such an end as a termination, time-outs included. The VecEnv must set it "
            "in every step to `truncated and not terminated`."
        )
    n = sum(end.last_obs is None for end in seen.ends)
    if n:
        problems.append(
            f"In {n} of {counted(len(seen.ends), 'end')}, infos[i] had no 'terminal_observation'. "
            "SB3 then stores the first observation of the next episode as the next observation. "
            "The VecEnv must put the last observation there when it resets a copy."
        )
    return problems


def _lost_observations(env: VecEnv, seen: Seen) -> list[str]:
    """Reported last observations that are implausible."""
    reported = [end for end in seen.ends if end.last_obs is not None]
    strange = [end for end in reported if not _fits(env, end.last_obs)]
    if strange:
        last = strange[0].last_obs
        found = type(last).__name__ if isinstance(last, dict) else f"of shape {np.shape(last)}"
        return [
            f"In {len(strange)} of {counted(len(reported), 'end')}, "
            f"infos[i]['terminal_observation'] was {found} instead of one "
            f"observation of {env.observation_space}. Put the row of that copy there."
        ]
    # If all episodes begin alike, an episode may also end where it began.
    starts_differ = any(not is_same(end.first_obs, reported[0].first_obs) for end in reported)
    n = sum(is_same(end.last_obs, end.first_obs) for end in reported)
    if not starts_differ or n < len(reported):
        return []
    return [
        f"In {n} of {counted(len(reported), 'end')}, infos[i]['terminal_observation'] was what "
        "step() returned as well: it is either the first observation of the next episode, whose "
        "value has nothing to do with the step before, or the copy was not reset. Keep the last "
        "observation before resetting, and return the first one of the next episode."
    ]


def _nothing_ended(seen: Seen) -> list[str]:
    if seen.ends:
        return []
    return [
        f"No episode ended in {seen.n_steps} steps, so it is not known how time-outs are reported. "
        "Pass a larger n_steps=; or, if nothing ever ends an episode, add a limit: "
        "gymnasium.wrappers.TimeLimit(env, max_episode_steps=...)."
    ]


def _unseen(seen: Seen, limit: int | None) -> list[str]:
    if not all(end.terminated for end in seen.ends):
        return []
    late = sum(end.length >= (limit or math.inf) for end in seen.ends)
    when = f", {late} of them at the limit of {limit} steps"
    if not late:
        when = f" before the limit of {limit} steps" if limit else ""
    return [
        f"No time-out was seen: all {counted(len(seen.ends), 'episode')} terminated{when}. How one "
        "is reported was not checked."
    ]


def _stacks(env: VecEnv) -> tuple[list[list[Limit]], list[gymnasium.Env]]:
    """:return: the limits around each copy, outermost first; and the copies in this process"""
    bare, around = _unwrapped(env, VecEnvWrapper, "venv")
    if isinstance(bare, GymnasiumVecEnv):
        bare, more = _unwrapped(bare.env, VectorWrapper, "env")
        around += more
    if isinstance(bare, DummyVecEnv | SyncVectorEnv):
        return [around + limits_of(copy) for copy in bare.envs], list(bare.envs)
    return [around + (own_limit(bare, *_NAMES) or _limit_of_copies(bare))], []


def _unwrapped(env: Any, wrapper: type, inner: str) -> tuple[Any, list[Limit]]:
    """:return: what is inside all wrappers of this class, and their limits"""
    limits = []
    while isinstance(env, wrapper):
        limits += own_limit(env, *_NAMES)
        env = getattr(env, inner)
    return env, limits


def _limit_of_copies(env: Any) -> list[Limit]:
    """The limit of copies in other processes, where the outermost wrapper answers first."""
    try:
        if isinstance(env, AsyncVectorEnv):
            # Asking for a missing attribute would end their processes.
            has_some = all(env.call("has_wrapper_attr", _NAMES[0]))
        else:
            has_some = env.has_attr(_NAMES[0])
        steps = max(env.get_attr(_NAMES[0])) if has_some else None
    except (AttributeError, NotImplementedError, TypeError, ValueError):
        return []
    return [Limit("the outermost wrapper", steps)] if isinstance(steps, int) and steps > 0 else []


def _fits(env: VecEnv, obs: Any) -> bool:
    space = env.observation_space
    if isinstance(space, gymnasium.spaces.Dict):
        return isinstance(obs, dict) and obs.keys() == space.spaces.keys()
    return np.shape(obs) == (space.shape or ())


def _subject(env: Any, seen: Seen) -> str:
    n_cut = sum(not end.terminated for end in seen.ends)
    return (
        f"Truncation of {name_of(env)}: in {counted(seen.n_steps, 'step')}, {n_cut} truncated and "
        f"{counted(len(seen.ends) - n_cut, 'terminated episode')}"
    )
