"""
SAC and gSDE-SAC with and without a rhythm under the policy: Swimmer-v5 and HalfCheetah-v5.

    python benchmarks/cpg_prior.py                 # 50,000 steps, three seeds
    python benchmarks/cpg_prior.py --figure        # redraw the figure from the table

The rhythm is not optimised: the joints follow a travelling wave, one after another, at a frequency
within the range of the search. ``residual`` and ``offset`` are modes of ``CPGPrior``. Each run is a
process of its own; its final policy is evaluated over 20 episodes, with the same resets for every
run. Finished runs are kept.
"""

import argparse
from functools import partial

import numpy as np
import pandas as pd
from runs import CACHE, RESULTS, arguments_of, fresh_process, resume, seconds_since_start

TAU = 2.0 * np.pi
#: a travelling wave for each environment: arguments of ``CPGPrior``
RHYTHMS = {
    "Swimmer-v5": {
        "omega_swing": TAU * 0.6,
        "amplitude": 1.0,
        "phase": [0.0, 0.75 * TAU],
        "kp": 10.0,
        "kd": 0.5,
    },
    "HalfCheetah-v5": {
        "omega_swing": TAU * 3.0,
        "amplitude": 0.7,
        "phase": [0.0, 0.25 * TAU, 0.5 * TAU, 0.5 * TAU, 0.75 * TAU, 0.0],
        "kp": 1.0,
        "kd": 0.05,
    },
}
#: effect of an action of 1: on commands, on targets [rad]
RANGES = {"residual": 0.5, "offset": 0.5}
PRIORS = ("none", "residual", "offset", "parameters")
LEARNERS = ("sac", "gsde_sac")
N_EPISODES = 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--envs", nargs="*", default=list(RHYTHMS))
    parser.add_argument("--learners", nargs="*", default=list(LEARNERS))
    parser.add_argument("--priors", nargs="*", default=list(PRIORS))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=50_000)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--figure", action="store_true")
    arguments = arguments_of(parser, worker)
    if not arguments.figure:
        wanted = [
            (env_id, learner, prior, seed, arguments.steps)
            for seed in range(arguments.seeds)
            for env_id in arguments.envs
            for learner in arguments.learners
            for prior in arguments.priors
        ]
        work = partial(fresh_process, __file__, cache=CACHE / "programs")
        keys = ("env", "learner", "prior", "seed", "steps")
        resume("cpg_prior", keys, wanted, work, arguments.jobs)
    report()


def worker(env_id: str, learner: str, prior: str, seed: int, steps: int) -> dict:
    """Learn once, then evaluate the policy."""
    from sb3_hds.experiments import returns_of

    model = algorithm(learner)("MlpPolicy", make(env_id, prior), seed=seed, **settings(learner))
    model.learn(steps)
    seconds = seconds_since_start()
    returns = returns_of(model, make(env_id, prior), N_EPISODES)
    return {"return": returns.mean(), "std": returns.std(), "seconds": seconds}


def make(env_id: str, prior: str):
    """:return: the environment, with the rhythm under it unless ``prior`` is "none" """
    import gymnasium

    from sb3_hds.wrappers import CPGPrior

    env = gymnasium.make(env_id)
    if prior == "none":
        return env
    changes = {"action_range": RANGES[prior]} if prior in RANGES else {}
    return CPGPrior(env, mode=prior, **RHYTHMS[env_id], **changes)


def algorithm(learner: str):
    """:return: SBX's SAC, or ours with gSDE"""
    from sbx import SAC

    from sb3_hds import GSDESAC

    return {"sac": SAC, "gsde_sac": GSDESAC}[learner]


def settings(learner: str) -> dict:
    """:return: what differs from the defaults: gSDE keeps its noise for eight steps"""
    return {"train_freq": 8, "gradient_steps": 8} if learner == "gsde_sac" else {}


def report() -> None:
    """Print and draw means over seeds."""
    table = pd.read_csv(RESULTS / "cpg_prior.csv")
    by = table.groupby(["env", "learner", "prior", "steps"])["return"]
    print(by.agg(["count", "mean", "min", "max"]).to_string(float_format="%.1f"))
    draw(table[table.steps == table.steps.max()])


def draw(table: pd.DataFrame) -> None:
    """One picture for each environment: every seed, by learner and prior."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 3.5), layout="constrained")
    shown = [env_id for env_id in RHYTHMS if (table.env == env_id).any()]
    priors = [prior for prior in PRIORS if (table.prior == prior).any()]
    for axes, env_id in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown, strict=True):
        for shift, learner in zip((-0.12, 0.12), LEARNERS, strict=True):
            rows = table[(table.env == env_id) & (table.learner == learner)]
            places = [priors.index(prior) + shift for prior in rows.prior]
            axes.plot(places, rows["return"], "o", alpha=0.7, label=learner)
        axes.set_xticks(range(len(priors)), priors)
        axes.set_xlim(-0.5, len(priors) - 0.5)
        axes.set_title(env_id)
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel(f"return after {table.steps.max():,} steps")
    figure.axes[0].legend(frameon=False)
    figure.savefig(RESULTS / "cpg_prior.png", dpi=150)


if __name__ == "__main__":
    main()
