"""
Train HDS on a pendulum with the stock ``rl_zoo3`` command, and show what it learned.

    python examples/demo.py --folder demo

writes the zoo's run folder and ``learning_curve.png`` into ``demo/``, and prints the return before
and after training on the same start states.
"""

import argparse
import subprocess
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
from rich.console import Console
from rich.table import Table

import sb3_hds
from sb3_hds.experiments import returns_of

ENV_ID = "Pendulum-v1"
N_EPISODES = 50
TRAINING_SEED = 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument("--folder", type=Path, default=Path("demo"), help="where results go")
    parser.add_argument("--n-timesteps", type=int, default=-1, help="steps of the environment")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)

    started = time.perf_counter()
    run = train(options.folder, options.n_timesteps)
    seconds = time.perf_counter() - started

    untrained = sb3_hds.HDS("MlpPolicy", ENV_ID, seed=TRAINING_SEED)
    trained = sb3_hds.HDS.load(run / f"{ENV_ID}.zip")
    env = gym.make(ENV_ID)
    before, after = (returns_of(model, env, N_EPISODES) for model in (untrained, trained))

    picture = options.folder / "learning_curve.png"
    draw(run, picture, before, after)
    report(before, after, trained.num_timesteps, seconds)
    print(f"Run folder: {run}\nLearning curve: {picture}")


def train(folder: Path, n_timesteps: int) -> Path:
    """:return: the folder of the run that ``rl_zoo3 train`` made"""
    zoo = Path(sys.executable).with_name("rl_zoo3")
    words = f"train --algo hds --env {ENV_ID} --seed {TRAINING_SEED} --eval-freq 200 -P"
    budget = ["-n", str(n_timesteps)] if n_timesteps > 0 else []
    logs = folder / "logs"
    subprocess.run([zoo, *words.split(), *budget, "-f", str(logs)], check=True)
    runs = logs.glob(f"hds/{ENV_ID}_*")
    return max(runs, key=lambda run: int(run.name.rpartition("_")[2]))


def draw(run: Path, picture: Path, before: np.ndarray, after: np.ndarray) -> None:
    """The return of the evaluations during training, with the values before and after it."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    evaluations = np.load(run / "evaluations.npz")
    timesteps = [0, *evaluations["timesteps"]]
    curve = [before.mean(), *evaluations["results"].mean(axis=1)]
    figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
    axes.axhline(
        after.mean(), color="0.3", linestyle=":", label=f"trained policy, {N_EPISODES} episodes"
    )
    axes.plot(timesteps, curve, marker="o", label="during training, 5 episodes each")
    axes.annotate(
        f"untrained policy, {N_EPISODES} episodes",
        (0, curve[0]),
        (12, 0),
        textcoords="offset points",
    )
    axes.set(
        title=f"HDS on {ENV_ID}", xlabel="steps of the environment", ylabel="return of an episode"
    )
    axes.legend()
    figure.savefig(picture, dpi=150)


def report(before: np.ndarray, after: np.ndarray, n_timesteps: int, seconds: float) -> None:
    table = Table(title=f"HDS on {ENV_ID}: {N_EPISODES} episodes from the same start states")
    for column in ("policy", "mean return", "standard error", "worst", "best"):
        table.add_column(column, justify="left" if column == "policy" else "right")
    for name, values in (("before training", before), ("after training", after)):
        error = values.std(ddof=1) / np.sqrt(len(values))
        numbers = (values.mean(), error, values.min(), values.max())
        table.add_row(name, *(f"{number:.1f}" for number in numbers))
    table.caption = (
        f"{n_timesteps} steps of the environment, {seconds:.0f} s of rl_zoo3 train, "
        "start of the interpreter, compilation and evaluations included"
    )
    Console().print(table)


if __name__ == "__main__":
    main()
