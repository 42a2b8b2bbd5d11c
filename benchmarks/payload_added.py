"""
A payload added during training: the number of episodes until a learner has recovered.

    python benchmarks/payload_added.py [--seeds 5] [--jobs 2]
    python benchmarks/payload_added.py --figure        # rebuild table and figure from the runs

The system is `sb3_hds/PendulumReal-v1` as its data sheet says, with sensor noise. After some real
episodes, a point mass of 0.25 kg is added to its tip (the rod weighs 1 kg) without the learner's
knowledge. HDS and SAC (SBX, RL Zoo's settings for Pendulum-v1) learn for ten episodes before that;
because SAC has learned little by then, it is also run with fifty. Returns are means over the same
50 start states of the loaded system. A learner has recovered at the first evaluation after which
all are within a tenth of the cost of the load (the policy without adaptation compared with PODS in
the true twin).
"""

import argparse
from functools import partial

import numpy as np
import pandas as pd
from hardware import CELLS, N_STARTS, PENDULUM, length_of, make, pretrained
from runs import CACHE, RESULTS, arguments_of, fresh_process, resume

BEFORE, AFTER, LOAD = "as described", "loaded", 0.25
CELLS[BEFORE] = (PENDULUM, {"noise": 0.01})
CELLS[AFTER] = (PENDULUM, {"noise": 0.01, "payload": LOAD})
#: real episodes before the load, and after it when learners are evaluated
METHODS = {"hds": 10, "sac": 10, "sac, 50 episodes before": 50, "ceiling": 0, "no adaptation": 0}
EPISODES = (0, 1, 2, 3, 5, 10, 20, 30)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--methods", nargs="*", default=list(METHODS))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--figure", action="store_true")
    arguments = arguments_of(parser, worker)
    if not arguments.figure:
        wanted = [(method, seed) for seed in range(arguments.seeds) for method in arguments.methods]
        in_process = partial(fresh_process, __file__, cache=CACHE)
        resume("payload_added", ("method", "seed"), wanted, in_process, arguments.jobs)
    report()


def worker(method: str, seed: int) -> list[dict]:
    from hardware import return_of

    if method in ("ceiling", "no adaptation"):
        return [{"episodes": 0, "return": return_of(planner(method, seed), AFTER)}]
    env = make(BEFORE)
    if method == "hds":
        model = pretrained(BEFORE, seed)
        model.set_env(env)
    else:
        from sbx import SAC

        model = SAC("MlpPolicy", env, seed=seed, learning_rate=1e-3)
    model.learn(METHODS[method] * length_of(BEFORE), reset_num_timesteps=False)
    env.unwrapped.set_payload(LOAD)
    rows, done = [], 0
    for episodes in EPISODES if method != "hds" else EPISODES[:-2]:
        if episodes > done:
            model.learn((episodes - done) * length_of(AFTER), reset_num_timesteps=False)
            done = episodes
        rows.append({"episodes": episodes, "return": return_of(model, AFTER)})
    return rows


def planner(method: str, seed: int):
    from sb3_hds import HDS, envs

    if method == "no adaptation":
        return pretrained(BEFORE, seed)
    env = make(AFTER)
    return HDS(env, twin=envs.true_twin(env), seed=seed).learn(0)


def report() -> None:
    table = pd.read_csv(RESULTS / "payload_added.csv")
    means = table.groupby(["method", "episodes"], sort=False)["return"].mean().unstack("episodes")
    means = means.reindex(list(METHODS)).dropna(how="all")
    best, worst = means.loc["ceiling", 0], means.loc["no adaptation", 0]
    enough = best - 0.1 * (best - worst)
    shown = means.rename(columns=lambda n: f"return after {n}").copy()
    for method in means.index.difference(["ceiling", "no adaptation"]):
        own = table[table["method"] == method]
        found = [recovered(group, enough) for _, group in own.groupby("seed")]
        shown.loc[method, "recovered after, by seed"] = ", ".join(map(_or_never, found))
    print(f"mean return over seeds and {N_STARTS} start states, by episodes since the load;")
    print(f"recovered: above {enough:.1f} from there on, seed by seed")
    print(shown.to_string(float_format=lambda x: f"{x:.1f}", na_rep=""))
    shown.to_csv(RESULTS / "payload_added_recovery.csv", float_format="%.5g")
    figure(table, best, worst)


def _or_never(episodes: int | None) -> str:
    return "never" if episodes is None else str(episodes)


def recovered(group: pd.DataFrame, enough: float) -> int | None:
    """:return: the first evaluation from which on all are good enough; None if there is none"""
    good = (group["return"] >= enough).to_numpy()
    stays = np.flip(np.logical_and.accumulate(np.flip(good)))
    return int(group["episodes"].iloc[np.argmax(stays)]) if stays.any() else None


def figure(table: pd.DataFrame, best: float, worst: float) -> None:
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(6.0, 3.4), layout="constrained")
    axes = drawing.subplots()
    colours = {"hds": "#27496d", "sac": "#d1495b", "sac, 50 episodes before": "#edae49"}
    for method, colour in colours.items():
        runs = table[table["method"] == method].pivot(
            index="episodes", columns="seed", values="return"
        )
        axes.plot(runs.index, runs.mean(axis=1), "o-", color=colour, label=method)
        axes.fill_between(runs.index, runs.min(axis=1), runs.max(axis=1), color=colour, alpha=0.15)
    axes.axhline(best, color="#9a978c", label="planned in the true twin")
    axes.axhline(worst, color="#9a978c", linestyle="--", label="no adaptation")
    axes.set_xlabel("real episodes since the load was added")
    axes.set_ylabel("return of the loaded pendulum")
    axes.legend(fontsize=7, frameon=False)
    drawing.savefig(RESULTS / "payload_added.png", dpi=150)


if __name__ == "__main__":
    main()
