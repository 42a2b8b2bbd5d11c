"""
The policy gain of a diagnosis: policies from the nominal, the diagnosed and the true twin.

    python benchmarks/policy_gain.py                # three hidden causes, five seeds
    python benchmarks/policy_gain.py --figure       # redraw the figure from the table

The real system is `sb3_hds/PendulumReal-v1` with a planted effect that the twin lacks, and noisy
sensors. Each seed makes ten recordings under random torques, diagnoses them, and trains HDS in each
twin without a real step, with the defaults of `measure_policy_gain`: all three policies act from
the same 20 start states. All trainings share one seed, so only the data differ between seeds. Each
run is a process of its own. Finished runs are kept.
"""

import argparse
from functools import partial

import numpy as np
import pandas as pd
from intervals import of_iqm
from runs import CACHE, RESULTS, arguments_of, fresh_process, resume, save, seconds_since_start

ROBOT = "sb3_hds/PendulumReal-v1"
NOISE = 0.01
#: what is planted, by the name of what should be found
HIDDEN = {
    "quadratic_drag": {"drag": 0.06},
    "coulomb_friction": {"friction": 0.6},
    "torque_gain": {"gain": 0.6},
}
#: twins in which policies are trained, by their names in `PolicyGain`
SIMULATIONS = {"believed": "nominal twin", "extended": "diagnosed twin", "true": "true twin"}
N_RECORDINGS, N_STEPS = 10, 200


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--hidden", nargs="*", default=list(HIDDEN), choices=HIDDEN)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--figure", action="store_true")
    arguments = arguments_of(parser, worker)
    if not arguments.figure:
        wanted = [(h, seed) for seed in range(arguments.seeds) for h in arguments.hidden]
        work = partial(fresh_process, __file__, cache=CACHE / "programs")
        resume("policy_gain", ("hidden", "seed"), wanted, work, arguments.jobs)
    report()


def worker(hidden: str, seed: int) -> list[dict]:
    """Record, diagnose, train: one row for each twin."""
    import gymnasium

    from sb3_hds import Trajectories, diagnose, twins
    from sb3_hds.experiments import measure_policy_gain

    real = gymnasium.make(ROBOT, max_episode_steps=N_STEPS, noise=NOISE, **HIDDEN[hidden])
    data = Trajectories.from_arrays(*recorded(real, seed), dt=real.unwrapped.dt)
    found = diagnose(twins.make(ROBOT), data, progress=False)
    diagnosed = seconds_since_start()
    gain = measure_policy_gain(found, real, seeds=1, progress=False)
    keys = [key for f in found.findings for key in (f.key, *f.alternatives)]
    diagnosis = {
        "verdict": found.verdict,
        "named": " ".join(f.key for f in found.findings),
        "within": any(key.startswith(f"{hidden}.") for key in keys),
        "diagnosed": diagnosed,
        "seconds": seconds_since_start(),
    }
    return [{"twin": s, "return": gain.of(s).mean} | diagnosis for s in SIMULATIONS]


def recorded(real, seed: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """:return: observations and actions of each recording"""
    rng, seen, done = np.random.default_rng(seed), [], []
    for episode in range(N_RECORDINGS):
        wander = 0.7 * rng.standard_normal(N_STEPS).cumsum() + rng.uniform(0.0, 6.0)
        torques = (1.6 * np.sin(wander))[:, None]
        obs = [real.reset(seed=N_RECORDINGS * seed + episode)[0]]
        obs += [real.step(torque)[0] for torque in torques]
        seen.append(np.array(obs))
        done.append(torques)
    return seen, done


def report() -> None:
    """Print, save and plot the intervals over seeds."""
    table = pd.read_csv(RESULTS / "policy_gain.csv")
    rows = [summary(hidden, own) for hidden, own in table.groupby("hidden", sort=False)]
    print(save(rows, "policy_gain_intervals").to_string(index=False))
    draw(table)


def summary(hidden: str, own: pd.DataFrame) -> dict:
    """:return: interquartile means over seeds with 95 % intervals, and the gain, paired by seed"""
    by = own.pivot(index="seed", columns="twin", values="return")
    nominal, extended, true = (by[s].to_numpy() for s in SIMULATIONS)
    diagnosed = own[own.twin == "extended"]
    first = diagnosed.named.astype(str).str.startswith(f"{hidden}.").sum()
    gap = of_iqm([true - nominal])[0]
    return {
        "hidden": hidden,
        "named first": f"{first} of {len(diagnosed)}",
        "within the set": f"{int(diagnosed.within.sum())} of {len(diagnosed)}",
        **{title: _with_interval(by[s].to_numpy()) for s, title in SIMULATIONS.items()},
        "gain": _with_interval(extended - nominal),
        "share of the gap": f"{of_iqm([extended - nominal])[0] / gap:.2f}" if gap > 0 else "-",
    }


def _with_interval(values: np.ndarray) -> str:
    middle, low, high = of_iqm([values])
    return f"{middle:.1f} [{low:.1f}, {high:.1f}]"


def draw(table: pd.DataFrame) -> None:
    """For each hidden cause the three twins, a line for each seed."""
    from matplotlib.figure import Figure

    shown = list(dict.fromkeys(table.hidden))
    figure = Figure(figsize=(2.6 * len(shown) + 0.6, 3.0), layout="constrained")
    panels = figure.subplots(1, len(shown), squeeze=False)[0]
    names = [title.removesuffix(" twin") for title in SIMULATIONS.values()]
    for axes, hidden in zip(panels, shown, strict=True):
        by = table[table.hidden == hidden].pivot(index="seed", columns="twin", values="return")
        for _, returns in by[list(SIMULATIONS)].iterrows():
            axes.plot(names, returns, "o-", color="#27496d", alpha=0.5, lw=1)
        axes.set_title(hidden.replace("_", " "), fontsize=10)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("return on the real system")
    figure.savefig(RESULTS / "policy_gain.png", dpi=150)


if __name__ == "__main__":
    main()
