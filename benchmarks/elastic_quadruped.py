"""
A quadruped with series elasticity: RL alone, an optimised rhythm, and combinations of both.

    python benchmarks/elastic_quadruped.py              # 50,000 steps, three seeds
    python benchmarks/elastic_quadruped.py --figure     # redraw the figure from the table

The environment is `sb3_hds/ElasticQuadruped-v0`; all methods have the same number of real steps:

- ``rl, position`` and ``rl, force``: gSDE-SAC alone; an action sets the angles of the motors, or
  the torques that the springs transmit
- ``plain rhythm``: a trot that was not optimised, without learning
- ``plain rhythm, torque``: the same targets, tracked by torques at the 50 Hz of the policy
- ``rhythm``: the trot that ``OpenLoop`` finds from there, all legs moving alike
- ``rhythm, free legs``: the same search over every joint, 25 parameters instead of seven
- ``rhythm, then rl``: half the steps for the search, the rest for gSDE-SAC, which adds offsets to
  the targets of the optimised gait
- ``rl over a plain rhythm``: the same offsets, over the plain trot
- ``rl sets the rhythm``: gSDE-SAC sets amplitudes and frequency of the plain trot at every step

All other rhythms command the angles of the motors, which the drives control at 500 Hz: a rotor on
15 N m/rad oscillates too fast for a loop at 50 Hz.

Each run is a process of its own; its final policy is evaluated over 20 episodes, with the same
resets for every run. Finished runs are kept.
"""

import argparse
import math
from functools import partial

import numpy as np
import pandas as pd
from runs import CACHE, RESULTS, arguments_of, fresh_process, resume, seconds_since_start

METHODS = (
    "rl, position",
    "rl, force",
    "plain rhythm",
    "plain rhythm, torque",
    "rhythm",
    "rhythm, free legs",
    "rhythm, then rl",
    "rl over a plain rhythm",
    "rl sets the rhythm",
)
#: a trot at 2 Hz: hips swing, knees a quarter of a turn ahead; two thirds of the range, 0.4 rad
PLAIN = {
    "omega_swing": 4.0 * math.pi,
    "omega_stance": 4.0 * math.pi,
    "amplitude": [2.0 / 3.0] * 8,
    "phase": [0.0, 0.5 * math.pi, math.pi, 1.5 * math.pi, math.pi, 1.5 * math.pi, 0, 0.5 * math.pi],
}
# A search of few episodes: one each, cut off after 5 s, and a third of the steps to rank the best.
SEARCH = {
    "horizon": 250,
    "n_resets": 1,
    "initial_sigma": 0.5,
    "ranking_share": 0.3,
    "frequency": (0.5, 6.0),
}
N_EPISODES = 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--methods", nargs="*", default=list(METHODS), choices=METHODS)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=50_000)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--figure", action="store_true")
    arguments = arguments_of(parser, worker)
    if not arguments.figure:
        wanted = [
            (method, seed, arguments.steps)
            for seed in range(arguments.seeds)
            for method in arguments.methods
        ]
        work = partial(fresh_process, __file__, cache=CACHE / "programs")
        resume("elastic_quadruped", ("method", "seed", "steps"), wanted, work, arguments.jobs)
    report()


def worker(method: str, seed: int, steps: int) -> dict:
    """Learn once, then evaluate the policy."""
    from sb3_hds.experiments import returns_of

    model, env = learned(method, seed, steps)
    seconds = seconds_since_start()
    returns = returns_of(model, env, N_EPISODES)
    return {"return": returns.mean(), "std": returns.std(), "seconds": seconds}


def learned(method: str, seed: int, steps: int):
    """:return: model, and environment that it acts in"""
    if method == "plain rhythm, torque":
        # Angles of the motors are not observed: the model reads those of its own environment.
        env = make("torque")
        return by_torques(env, seed), env
    if method in ("plain rhythm", "rhythm", "rhythm, free legs"):
        model = plain(seed, gait=None if method == "rhythm, free legs" else "trot")
        return model if method == "plain rhythm" else model.learn(steps), make("position")
    if method == "rhythm, then rl":
        gait = plain(seed).learn(steps // 2).constants
        env = over(gait, "offset", action_range=0.3)
        return with_rl(env, seed, steps - steps // 2), env
    env = {
        "rl, position": lambda: make("position"),
        "rl, force": lambda: make("force"),
        "rl over a plain rhythm": lambda: over(PLAIN, "offset", action_range=0.3),
        "rl sets the rhythm": lambda: over(PLAIN, "parameters"),
    }[method]()
    return with_rl(env, seed, steps), env


def make(control: str):
    import gymnasium

    import sb3_hds  # noqa: F401

    return gymnasium.make("sb3_hds/ElasticQuadruped-v0", control=control)


def over(gait: dict, mode: str, **settings):
    """:return: the environment with a rhythm under the policy"""
    from sb3_hds.wrappers import CPGPrior

    return CPGPrior(make("position"), mode=mode, **gait, **settings)


def plain(seed: int, gait: str | None = "trot"):
    """:return: the plain trot, from which a search can start"""
    from sb3_hds import OpenLoop

    model = OpenLoop("MlpPolicy", make("position"), seed=seed, gait=gait, **SEARCH)
    return model.set_constants(**PLAIN)


def by_torques(env, seed: int):
    """:return: the plain trot, its targets in rad and the gains of the drive in its commands"""
    from sb3_hds import OpenLoop

    angles = PLAIN | {"amplitude": [0.4] * 8, "kp": 6.0, "kd": 0.14}
    return OpenLoop("MlpPolicy", env, seed=seed).set_constants(**angles)


def with_rl(env, seed: int, steps: int):
    from sb3_hds import GSDESAC

    settings = {"train_freq": 8, "gradient_steps": 8, "gamma": 0.98}
    return GSDESAC("MlpPolicy", env, seed=seed, **settings).learn(steps)


def report() -> None:
    """Print and draw all runs."""
    table = pd.read_csv(RESULTS / "elastic_quadruped.csv")
    by = table.groupby(["method", "steps"], sort=False)["return"]
    print(by.agg(["count", "median", "min", "max"]).to_string(float_format="%.1f"))
    draw(table[table.steps == table.steps.max()])


def draw(table: pd.DataFrame) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 3.4), layout="constrained")
    axes = figure.subplots()
    shown = [method for method in METHODS if (table.method == method).any()]
    for place, method in enumerate(shown):
        returns = table[table.method == method]["return"]
        axes.plot(returns, np.full(len(returns), place), "o", color="#27496d", alpha=0.6)
        axes.plot([returns.median()] * 2, [place - 0.25, place + 0.25], color="#27496d", lw=2)
    axes.set_yticks(range(len(shown)), shown)
    axes.invert_yaxis()
    axes.set_xlabel(f"return after {table.steps.max():,} steps")
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(RESULTS / "elastic_quadruped.png", dpi=150)


if __name__ == "__main__":
    main()
