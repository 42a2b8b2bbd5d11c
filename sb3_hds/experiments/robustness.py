"""Returns of a policy under sensor noise, sensor failures and pushes."""

import dataclasses
import functools
import math
import textwrap
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from jaxtyping import Float
from rich.progress import track
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from sb3_hds.algos import OpenLoop
from sb3_hds.errors import EnvironmentMismatchError, TrajectoryError
from sb3_hds.experiments.returns import FIRST_START
from sb3_hds.wrappers import Perturb
from sb3_hds.wrappers.episodes import step_limit_of

#: arguments of :class:`~sb3_hds.wrappers.Perturb`, by name in the table
PERTURBATIONS: dict[str, dict[str, Any]] = {
    "none": {},
    "noise 0.25": {"noise": 0.25},
    "noise 0.5": {"noise": 0.5},
    "sensor zero": {"failing": "zero"},
    "sensor constant": {"failing": "constant"},
    "push": {"push": 5.0},
}


@dataclasses.dataclass(frozen=True, repr=False)
class Robustness:
    """
    Returns of one policy under perturbations. Prints itself.

    :param returns: by perturbation, one per episode; initial states are the same for all
    :param left_out: perturbations that the environment does not support, and why
    """

    returns: Mapping[str, Float[np.ndarray, " episodes"]]
    left_out: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def share(self, perturbation: str) -> float | None:
        """:return: mean return relative to the unperturbed one; None unless that is positive"""
        unperturbed = float(np.mean(self.returns["none"]))
        return (
            float(np.mean(self.returns[perturbation])) / unperturbed if unperturbed > 0.0 else None
        )

    def to_rows(self) -> list[dict[str, Any]]:
        """:return: plain data, one row per perturbation; None for undefined numbers"""
        return [
            {
                "perturbation": name,
                "return": float(np.mean(values)),
                "std": float(np.std(values)) if len(values) > 1 else None,
                "worst": float(np.min(values)),
                "share": self.share(name),
            }
            for name, values in self.returns.items()
        ]

    def __str__(self) -> str:
        n, rows = len(self.returns["none"]), self.to_rows()
        over = f"over {n} episodes from the same initial states" if n > 1 else "of one episode each"
        widths = {"return": 10, "std": 9, "worst": 10, "share": 8}
        if n == 1:
            del widths["std"], widths["worst"]
        if rows[0]["share"] is None:
            del widths["share"]
        header = "".join(f"{name:>{width}}" for name, width in widths.items())
        lines = [f"Return {over}:", f"  {'perturbation':<16}{header}"]
        for row in rows:
            cells = "".join(_cell(name, row[name], width) for name, width in widths.items())
            lines.append(f"  {row['perturbation']:<16}{cells}")
        notes = [f"{name} is left out: {why}" for name, why in self.left_out.items()]
        if "share" not in widths:
            notes.append("The unperturbed return is not positive, so there are no shares of it.")
        for note in notes:
            lines += textwrap.wrap(note, 78, initial_indent="  ", subsequent_indent="  ")
        return "\n".join(lines)

    __repr__ = __str__


def _cell(name: str, value: float, width: int) -> str:
    if not math.isfinite(value):
        return f"{'infinite':>{width}}"
    return f"{value:>{width}.{2 if name == 'share' else 1}f}"


def measure_robustness(
    model: BaseAlgorithm,
    env: str | Callable[[], gymnasium.Env],
    *,
    wrapper: Callable[[gymnasium.Env], gymnasium.Env] | None = None,
    perturbations: Mapping[str, Mapping[str, Any]] = PERTURBATIONS,
    n_episodes: int = 20,
    encoders: str = "own",
    normalize: str | None = None,
    progress: bool = True,
) -> Robustness:
    """
    Run the deterministic policy under each perturbation, from the same initial states.

    Noise and failures affect observations. The motors of an open-loop gait have their own encoders,
    as on a robot, which are not affected; with ``encoders="observation"``, the controller that
    tracks joints uses the perturbed observations. Pushes affect all policies. Perturbations that
    the environment does not support, such as a push without MuJoCo, are left out and reported.

    Source: after Raffin et al., *An Open-Loop Baseline*, RLJ 2024, table 2; it does not define
    units, sensors and pushes, see :class:`~sb3_hds.wrappers.Perturb` for the definitions here.

    :param model: any saved model of Stable-Baselines3, SBX or this package
    :param env: id of the environment, or a function that makes it
    :param wrapper: applies the wrappers of the training; they see perturbed observations, as behind
        the sensors of a robot
    :param perturbations: arguments of ``Perturb`` by name, including ``"none"``
    :param n_episodes: per perturbation
    :param encoders: ``"own"`` or ``"observation"``
    :param normalize: file of the ``VecNormalize`` of the training
    :param progress: whether to show a progress bar
    :raises TrajectoryError: for fewer than one episode, or without the perturbation ``"none"``
    :raises EnvironmentMismatchError: if observations cannot be perturbed, do not fit the model, or
        episodes have no step limit
    """
    if n_episodes < 1 or "none" not in perturbations or encoders not in ("own", "observation"):
        raise TrajectoryError(
            f"measure_robustness takes n_episodes of at least 1 (got {n_episodes}), a perturbation "
            f"'none' among others (got {', '.join(perturbations)}), and encoders 'own' or "
            f"'observation' (got {encoders!r})."
        )
    make = functools.partial(_perturbed, env, wrapper or (lambda inner: inner))
    _check_fits(model, make(perturbations["none"]))
    returns, left_out = {}, _unsupported(make, perturbations)
    supported = {name: how for name, how in perturbations.items() if name not in left_out}
    shown = track(supported.items(), "perturbing", transient=True, disable=not progress)
    for name, settings in shown:
        venv: VecEnv = DummyVecEnv([functools.partial(make, settings)])
        try:
            seen = VecNormalize.load(normalize, venv) if normalize else venv
            if isinstance(seen, VecNormalize):
                seen.training, seen.norm_reward = False, False
            returns[name] = _returns(model, seen, n_episodes, encoders)
        finally:
            venv.close()
    return Robustness(returns, left_out)


def _perturbed(
    env: str | Callable[[], gymnasium.Env],
    wrapper: Callable[[gymnasium.Env], gymnasium.Env],
    settings: Mapping[str, Any],
) -> gymnasium.Env:
    made = gymnasium.make(env) if isinstance(env, str) else env()
    return wrapper(Perturb(made, **settings))


def _check_fits(model: BaseAlgorithm, env: gymnasium.Env) -> None:
    limit = step_limit_of(env)
    env.close()
    if limit is None:
        raise EnvironmentMismatchError(
            f"{env} has no step limit, so that an episode might never end: wrap it in "
            "gymnasium.wrappers.TimeLimit, or make it with max_episode_steps."
        )
    ours = model.observation_space, model.action_space
    for mine, given in zip(ours, (env.observation_space, env.action_space), strict=True):
        if type(mine) is not type(given) or mine.shape != given.shape:
            raise EnvironmentMismatchError(
                f"The model was trained with {mine}, and the environment has {given}. Make it with "
                "the same arguments and wrappers as in the training."
            )


def _unsupported(
    make: Callable[[Mapping[str, Any]], gymnasium.Env],
    perturbations: Mapping[str, Mapping[str, Any]],
) -> dict[str, str]:
    """:return: the unsupported perturbations, and why, before any episode is run"""
    reasons = {}
    for name, settings in perturbations.items():
        try:
            make(settings).close()
        except EnvironmentMismatchError as error:
            if name == "none":
                raise
            reasons[name] = str(error)
    return reasons


def _returns(
    model: BaseAlgorithm, env: VecEnv, n_episodes: int, encoders: str
) -> Float[np.ndarray, " episodes"]:
    gait = model if isinstance(model, OpenLoop) and encoders == "own" else None
    if gait is None or (gait.robot or {}).get("control") != "track":
        return np.array([_episode(model, env, FIRST_START + i) for i in range(n_episodes)])
    before = gait.policy.read_states
    gait.read_joints_from(env)
    try:
        return _returns(model, env, n_episodes, "observation")
    finally:
        gait.policy.read_states = before


def _episode(model: BaseAlgorithm, env: VecEnv, seed: int) -> float:
    env.seed(seed)
    obs: Any = env.reset()
    state, start, total = None, np.ones(1, bool), 0.0
    while True:
        action, state = model.predict(obs, state, start, deterministic=True)
        obs, reward, start, _ = env.step(action)
        total += float(reward[0])
        if start[0]:
            return total
