"""
Find out what is wrong with a simulation, correct it, and train in the corrected one.

    python examples/demo_diagnosis.py --folder demo

The "robot" is a pendulum on MuJoCo's engine with air drag, of which `diagnose` is not told. Writes
the recordings, ``report.html``, its figures (one is in the README) and ``policy_gain.png`` into
``demo/``, and prints the return on the robot of policies from both twins.
"""

import argparse
from pathlib import Path

import gymnasium as gym
import numpy as np

from sb3_hds import Trajectories, diagnose, twins
from sb3_hds.experiments import measure_policy_gain
from sb3_hds.wrappers import Record

ROBOT = "sb3_hds/PendulumReal-v1"
HIDDEN = {"drag": 0.06, "noise": 0.01}
N_RECORDINGS, N_STEPS = 10, 200
EPOCHS = 50  # of planning: a demonstration must not take long


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument("--folder", type=Path, default=Path("demo"), help="where results go")
    parser.add_argument("--seeds", type=int, default=1, help="policies from each twin")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)

    data = record(options.folder / "recordings.jsonl")
    found = diagnose(twins.make(ROBOT), data)
    print(found)
    figures = found.save_pictures(options.folder)

    print(f"Runs in each twin: {options.seeds}. For a comparison use five: --seeds 5")
    gain = measure_policy_gain(
        found, robot(), seeds=options.seeds, ceiling=False, pretrain_epochs=EPOCHS
    )
    print(gain)
    report = found.to_html(options.folder / "report.html", gain.to_dict())
    picture = gain.plot(options.folder / "policy_gain.png")
    print(f"Report: {report}\nFigures: {', '.join(map(str, figures))}")
    print(f"Return on the robot: {picture}")


def robot() -> gym.Env:
    return gym.make(ROBOT, max_episode_steps=N_STEPS, **HIDDEN)


def record(path: Path) -> Trajectories:
    """Ten recordings of sinusoidal torques with a random phase, written step by step."""
    path.unlink(missing_ok=True)
    env, rng = Record(robot(), path), np.random.default_rng(0)
    for episode in range(N_RECORDINGS):
        env.reset(seed=episode)
        wander = 0.7 * rng.standard_normal(N_STEPS).cumsum() + rng.uniform(0.0, 6.0)
        for torque in 1.6 * np.sin(wander):
            env.step(np.array([torque]))
    env.close()
    return Trajectories.load(path)


if __name__ == "__main__":
    main()
