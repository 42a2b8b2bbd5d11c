"""
Open-loop gaits from scratch: return and wall time in five MuJoCo environments.

    python benchmarks/open_loop.py                      # 200,000 steps, five seeds
    python benchmarks/open_loop.py --steps 1000000
    python benchmarks/open_loop.py --figure             # redraw the figure from the table

Each run is a process of its own with the hyperparameters of ``hyperparams/openloop.yml``, which are
for 200,000 steps, and longer rollouts for more steps; its time counts from the start of the
interpreter. The final gait is evaluated over 20 episodes, with the same resets for every seed.
Finished runs are kept.
"""

import argparse
import json
from functools import partial
from pathlib import Path

import pandas as pd
from runs import CACHE, RESULTS, arguments_of, fresh_process, resume, seconds_since_start

#: environment to the median return that 200,000 steps should reach
TARGETS = {
    "Swimmer-v5": 290.0,
    "HalfCheetah-v5": 1000.0,
    "Hopper-v5": 1000.0,
    "Walker2d-v5": 500.0,
    "Ant-v5": 700.0,
}
N_EPISODES = 20
#: what changes with more than 200,000 steps: a gait that runs for 100 steps may fall over later
LONGER = {"HalfCheetah-v5": {"horizon": 250}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--envs", nargs="*", default=list(TARGETS))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--figure", action="store_true")
    arguments = arguments_of(parser, worker)
    if not arguments.figure:
        wanted = [(e, s, arguments.steps) for s in range(arguments.seeds) for e in arguments.envs]
        work = partial(fresh_process, __file__, cache=CACHE / "programs")
        resume("open_loop", ("env", "seed", "steps"), wanted, work, arguments.jobs)
    report()


def worker(env_id: str, seed: int, steps: int) -> dict:
    """Search once, then evaluate the gait."""
    import gymnasium

    from sb3_hds import OpenLoop
    from sb3_hds.experiments import returns_of

    settings = hyperparameters(env_id) | (LONGER.get(env_id, {}) if steps > 200_000 else {})
    model = OpenLoop("MlpPolicy", env_id, seed=seed, **settings).learn(steps)
    seconds = seconds_since_start()
    returns = returns_of(model, gymnasium.make(env_id), N_EPISODES)
    space = model.gait_space
    return {
        "return": returns.mean(),
        "std": returns.std(),
        "worst": returns.min(),
        "target": TARGETS.get(env_id) if steps == 200_000 else None,
        "searched": space.dim,
        "generations": int(model.policy.search.generation),
        "seconds": seconds,
        "gait": json.dumps(
            {name: _rounded(value) for name, value in model.constants.items()},
            separators=(",", ":"),
        ),
    }


def _rounded(value: float | list[float]) -> float | list[float]:
    return [round(v, 3) for v in value] if isinstance(value, list) else round(value, 3)


def hyperparameters(env_id: str) -> dict:
    """:return: those of the zoo's file, without the keys of the zoo itself"""
    import yaml

    path = Path(__file__).parent.parent / "hyperparams" / "openloop.yml"
    entries = yaml.safe_load(path.read_text())
    entry = entries.get(env_id, entries["default"])
    return {key: value for key, value in entry.items() if key not in ("n_timesteps", "policy")}


def report() -> None:
    """Print medians over seeds, and draw them with every seed."""
    table = pd.read_csv(RESULTS / "open_loop.csv")
    by = table.groupby(["env", "steps"])
    summary = by.agg(
        seeds=("seed", "count"),
        median=("return", "median"),
        lowest=("return", "min"),
        highest=("return", "max"),
        target=("target", "first"),
        minutes=("seconds", lambda s: s.median() / 60.0),
    )
    print(summary.to_string(float_format="%.1f"))
    draw(table[table.steps == 200_000])


def draw(table: pd.DataFrame) -> None:
    """One picture for each environment: every seed, the median, and the target."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.0), layout="constrained")
    shown = [env_id for env_id in TARGETS if (table.env == env_id).any()]
    for axes, env_id in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown, strict=True):
        runs = table[table.env == env_id]["return"]
        axes.plot([0.0] * len(runs), runs, "o", color="#27496d", alpha=0.6)
        axes.plot([-0.3, 0.3], [runs.median()] * 2, color="#27496d", lw=2)
        axes.axhline(TARGETS[env_id], color="#d1495b", lw=1, ls="--")
        axes.set(xlim=(-1.0, 1.0), xticks=[], title=env_id)
        axes.set_ylim(bottom=min(0.0, float(runs.min())))
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("return after 200,000 steps")
    figure.savefig(RESULTS / "open_loop.png", dpi=150)


if __name__ == "__main__":
    main()
