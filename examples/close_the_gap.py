"""
From a recording that leaves two answers open to a policy for the right one, in two recordings.

    python examples/close_the_gap.py --folder gap

The "robot" is a pendulum on MuJoCo's engine with drag. In gentle motion, friction explains as much.
Prints, for each station, the return on the robot of a policy that is trained there without a single
step on it, and draws everything in ``gap/close_the_gap.png``.
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_hds import HDS, Trajectories, diagnose, effects, envs, twins
from sb3_hds.experiments import returns_of
from sb3_hds.sysid import Diagnosis, NextExperiment

ROBOT = "sb3_hds/PendulumReal-v1"
HIDDEN: dict[str, Any] = {"drag": 0.06, "noise": 0.02}
SUSPECTS = [effects.ViscousFriction, effects.CoulombFriction, effects.QuadraticDrag]
HANGING = {"state": (np.pi, 0.0)}
# What the robot may do while it is being identified [rad/s, N m], and for how long [s].
LIMITS, SECONDS = {"velocity": 6.0, "torque": 1.8}, 5.0
N_RECORDINGS, N_STEPS, GENTLE = 8, 100, 0.6  # [N m]
EPOCHS, EPISODES = 60, 20


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").strip().splitlines()[0])
    parser.add_argument("--folder", type=Path, default=Path("gap"), help="where results go")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)

    nominal = twins.make(ROBOT)
    returns = {"as believed": trained_in(nominal)}

    rng = np.random.default_rng(0)
    phases = 0.7 * rng.standard_normal((N_RECORDINGS, N_STEPS)).cumsum(1)
    data = recorded(GENTLE * np.sin(phases)[..., None], "gentle", seed=0)
    found = diagnose(nominal, data, effects=SUSPECTS, progress=False)
    print(found, found.belief, sep="\n\n")
    returns["first name"] = trained_in(found.answers.answers[0].twin)
    returns["belief"] = trained_in(found.belief)

    start = np.array([-1.0, 0.0, 0.0])
    asked = found.next_experiment(LIMITS, seconds=SECONDS, start=start, progress=False)
    print(asked)
    asked.save(options.folder / "next.csv")
    more = recorded(asked.commands.actions, "asked for", seed=100)
    after = found.decided_by(more)
    print(after)
    returns["decided"] = trained_in(after.answers[0].twin)
    returns["truth"] = trained_in(envs.true_twin(robot()))

    for station, values in returns.items():
        print(f"{station:12s} {values.mean():8.1f}")
    picture = options.folder / "close_the_gap.png"
    draw(found, asked, more, after, returns).savefig(picture, dpi=150)
    print(f"Picture: {picture}")


def robot(**changes: Any) -> gym.Env:
    return gym.make(ROBOT, **(HIDDEN | changes))


def recorded(commands: np.ndarray, conditions: str, seed: int) -> Trajectories:
    """
    :param commands: torques of each recording [N m], shape ``(n, steps, 1)``
    :param conditions: under which name they are kept
    :param seed: of the first recording's noise
    :return: what the robot's sensors say, from hanging at rest
    """
    env, seen = robot(), []
    for i, torques in enumerate(commands):
        obs = [env.reset(seed=seed + i, options=HANGING)[0]]
        seen.append(np.array(obs + [env.step(torque)[0] for torque in torques]))
    return Trajectories.from_arrays(seen, commands, dt=0.05, conditions=conditions)


def trained_in(twin: Any) -> np.ndarray:
    """:return: returns on the robot of a policy that is trained in this twin alone"""
    model = HDS("MlpPolicy", envs.TwinVecEnv(twin), seed=0, pretrain_epochs=EPOCHS)
    return returns_of(model.learn(0), robot(noise=0.0), EPISODES)


def draw(
    found: Diagnosis,
    asked: NextExperiment,
    more: Trajectories,
    after: Any,
    returns: dict[str, np.ndarray],
) -> Any:
    """:return: the recording that was asked for, the weights of the answers, and the returns"""
    from matplotlib.figure import Figure

    blue, red, grey = "#27496d", "#d1495b", "#9a978c"
    figure = Figure(figsize=(9.0, 6.0), layout="constrained")
    panels: Any = figure.subplot_mosaic([["motion", "motion"], ["weights", "earned"]])
    motion, weights, earned = (panels[name] for name in ("motion", "weights", "earned"))
    times = more.dt * np.arange(more.obs.shape[1])
    for own, name, colour in zip(asked.predicted, asked.answers, (blue, red, grey), strict=False):
        motion.plot(times, own[0, :, 2], color=colour, lw=2, label=f"if it is {name}")
    motion.plot(times, more.obs[0, :, 2], ".", color="#3b3a36", ms=4, label="recorded")
    motion.set(title="The recording that was asked for", xlabel="time [s]", ylabel="speed [rad/s]")
    motion.legend(frameon=False, fontsize=8)

    names = list(asked.answers)
    before = dict(zip(names, found.answers.weights, strict=True))
    now = dict(zip((a.name for a in after.answers), after.weights, strict=True))
    rows = np.arange(len(names))
    weights.barh(rows - 0.2, [before[n] for n in names], 0.35, color=grey, label="gentle motion")
    weights.barh(rows + 0.2, [now[n] for n in names], 0.35, color=blue, label="and one recording")
    weights.set_yticks(rows, [n.replace(".", "\n") for n in names], fontsize=8)
    weights.invert_yaxis()
    weights.set(title="Weight of each answer", xlim=(0.0, 1.0))
    weights.legend(frameon=False, fontsize=8)

    for i, values in enumerate(returns.values()):
        earned.plot(np.full(len(values), i), values, ".", color=grey, alpha=0.5)
        earned.plot(i, values.mean(), "o", color=blue, ms=8)
    earned.set_xticks(range(len(returns)), [n.replace(" ", "\n") for n in returns], fontsize=8)
    earned.set(title="Return on the robot", ylabel="return of an episode")
    for axes in (motion, weights, earned):
        axes.spines[["top", "right"]].set_visible(False)
    return figure


if __name__ == "__main__":
    main()
