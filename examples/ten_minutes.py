"""
From scratch in ten minutes: a pendulum that runs in real time, and a learner beside it.

    python examples/ten_minutes.py [--minutes 10]
    python examples/ten_minutes.py --folder benchmarks/results   # what the documentation shows

The pendulum (`sb3_hds/PendulumReal-v1`) is heavier, longer and rougher than its data sheet says. It
is controlled at 20 Hz against a clock and never waits: planning, calibration and regression run in
another thread, and whatever policy is there acts. The clock starts before anything was learned or
compiled. Writes `ten_minutes.png` and `ten_minutes.csv`, a row for each episode.
"""

import argparse
import csv
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import gymnasium
import numpy as np
from rich.console import Console

from sb3_hds import HDS

PERIOD = 0.05  # [s]
HIDDEN = {"mass": 1.2, "length": 1.15, "damping": 0.05, "friction": 0.05, "noise": 0.01}
# Real steps after which the model is corrected again.
BLOCK = 100


def main(words: Sequence[str] | None = None) -> None:
    """:param words: of the command line; None: those that the script was called with"""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, default=Path("ten_minutes"))
    arguments = parser.parse_args(words)
    begin = time.monotonic()
    env = gymnasium.make("sb3_hds/PendulumReal-v1", **HIDDEN)
    learner = Learner(HDS(env, twin="PendulumReal", seed=arguments.seed, n_rollouts=64))
    learner.start()
    try:
        episodes = control(learner, begin, 60.0 * arguments.minutes)
    finally:
        learner.end()
    learner.check()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    write(episodes, arguments.folder)


class Learner(threading.Thread):
    """
    Plans in the twin as it is; whenever enough steps have come, corrects it and plans on.

    :param model: without anything learned
    """

    def __init__(self, model: HDS) -> None:
        super().__init__(daemon=True)
        self.model = model
        self._ended = threading.Event()
        self._error: BaseException | None = None

    def run(self) -> None:
        try:
            self._learn()
        except BaseException as error:
            self._error = error

    def check(self) -> None:
        """:raises BaseException: that ended the learning"""
        if self._error is not None:
            raise self._error

    def end(self) -> None:
        """Return when the epoch that is running is done, also if the pretraining is not."""
        self._ended.set()
        self.model.pretrain_epochs = 0
        self.join()

    def _learn(self) -> None:
        model, corrected_at = self.model, 0
        model.learn(0)
        while not self._ended.is_set():
            n_steps = model.replay_buffer.size()
            model.real_timesteps = n_steps
            if n_steps - corrected_at >= BLOCK:
                corrected_at = n_steps
                model.correct_model(model.gradient_steps)
            model.run_epoch(model.gradient_steps)


def control(learner: Learner, begin: float, seconds: float) -> list[dict]:
    """
    Act against the clock, store every step, and print each episode.

    :raises BaseException: as soon as the learner has failed: the policy would stay as it is
    """
    model = learner.model
    env, console = model.get_env(), Console()
    episodes, late, tick = [], 0, time.monotonic()
    obs, total, n_steps = env.reset(), 0.0, 0
    while time.monotonic() - begin < seconds:
        learner.check()
        action, _ = model.predict(obs, deterministic=True)
        after, reward, done, info = env.step(action)
        last = info[0].get("terminal_observation", after[0])[None]
        scaled = model.policy.scale_action(action)
        model.replay_buffer.add(obs, last, scaled, reward, done, info)
        obs, total, n_steps = after, total + float(reward[0]), n_steps + 1
        if done[0]:
            minutes = (time.monotonic() - begin) / 60.0
            episodes.append({"minutes": minutes, "steps": n_steps, "return": total, "late": late})
            console.print(f"{minutes:5.1f} min  {n_steps:6d} steps  return {total:8.1f}")
            total = 0.0
        tick += PERIOD
        behind = time.monotonic() - tick
        if behind > 0.0:
            late, tick = late + 1, tick + behind
        else:
            time.sleep(-behind)
    console.print(f"{late} of {n_steps} control steps came late.")
    return episodes


def write(episodes: list[dict], folder: Path) -> None:
    from matplotlib.figure import Figure

    with (folder / "ten_minutes.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, ["minutes", "steps", "return", "late"])
        table.writeheader()
        table.writerows(episodes)
    figure = Figure(figsize=(6.0, 3.2), layout="constrained")
    axes = figure.subplots()
    minutes, returns = (np.array([e[key] for e in episodes]) for key in ("minutes", "return"))
    axes.plot(minutes, returns, "o-", color="#27496d", markersize=3.0)
    axes.set_xlabel("minutes since the start, compilation included")
    axes.set_ylabel("return of an episode")
    axes.set_title("A pendulum at 20 Hz, learning while it runs")
    figure.savefig(folder / "ten_minutes.png", dpi=150)


if __name__ == "__main__":
    main()
