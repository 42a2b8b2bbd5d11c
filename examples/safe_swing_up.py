"""
Swinging a pendulum up without hitting the end of the rail: what each ingredient changes.

    python examples/safe_swing_up.py [--steps 6000] [--seeds 1] [--without barrier]

The pivot of the pendulum moves along a rail of 1.2 m as fast as it is told, as a stepper drives it.
Four ingredients make learning on such hardware bearable: exploration that is smooth (gSDE), a
low-pass behind the policy, a barrier in front of the ends of the rail, and a time limit that
truncates instead of terminating. Each is left out once. Prints a table, and writes
``safe_swing_up/safe_swing_up.csv`` and ``.png``; with ``--folder benchmarks/results`` they are what
the page on smooth and safe actions shows.
"""

import argparse
import csv
import math
from collections.abc import Sequence
from pathlib import Path

import gymnasium
import numpy as np
from gymnasium import spaces

from sb3_hds import GSDESAC
from sb3_hds.wrappers import JointLimitBarrier, LowPassAction, TruncateToTerminate

DT, SUBSTEPS = 0.05, 5  # [s]
RAIL, SPEED = 0.6, 2.0  # [m] to either side, [m/s]
GRAVITY, LENGTH, DAMPING = 9.81, 0.5, 0.1  # [m/s2], [m], [1/s]
EPISODE = 200
INGREDIENTS = ("gSDE", "low-pass", "barrier", "truncation")
MEASURES = {
    "return": "return after training",
    "violations": "hits of the rail's ends while training",
    "continuity": "continuity cost while training",
}


class RailPendulum(gymnasium.Env):
    """
    A pendulum whose pivot is commanded by its speed; its ends of the rail stop it dead.

    Observes place [m] and speed [m/s] of the pivot, cosine and sine of the angle from upright, and
    its speed [rad/s]. The reward is 1 upright at the middle of the rail, at rest.
    """

    dt = DT

    def __init__(self) -> None:
        high = np.array([RAIL, SPEED, 1.0, 1.0, 50.0], np.float32)
        self.observation_space = spaces.Box(-high, high)
        self.action_space = spaces.Box(-SPEED, SPEED, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.speed = self.np_random.uniform(-0.3, 0.3), 0.0
        self.angle = math.pi + self.np_random.uniform(-0.2, 0.2)
        self.turning = 0.0
        return self._observe(), {}

    def step(self, action):
        command = float(np.clip(action[0], -SPEED, SPEED))
        place = self.place + command * DT
        hit = abs(place) > RAIL
        reached = float(np.clip(place, -RAIL, RAIL))
        speed = (reached - self.place) / DT
        push = (speed - self.speed) / DT
        for _ in range(SUBSTEPS):
            pull = GRAVITY * math.sin(self.angle) - push * math.cos(self.angle)
            self.turning += (pull / LENGTH - DAMPING * self.turning) * DT / SUBSTEPS
            self.angle += self.turning * DT / SUBSTEPS
        self.turning = float(np.clip(self.turning, -50.0, 50.0))
        self.place, self.speed = reached, speed
        upright = 0.5 * (1.0 + math.cos(self.angle))
        still = math.exp(-0.02 * self.turning**2 - 0.5 * (self.place / RAIL) ** 2)
        reward = 0.5 * upright + 0.5 * upright**4 * still
        return self._observe(), reward, False, False, {"hit": hit, "command": command}

    def _observe(self):
        seen = [self.place, self.speed, math.cos(self.angle), math.sin(self.angle), self.turning]
        return np.array(seen, np.float32)


class Protocol(gymnasium.Wrapper):
    """Counts hits of the ends, and adds up squared changes of the command."""

    def __init__(self, env):
        super().__init__(env)
        self.steps, self.hits, self.changes, self.last = 0, 0, 0.0, 0.0

    def reset(self, **settings):
        self.last = 0.0
        return self.env.reset(**settings)

    def step(self, action):
        obs, reward, terminated, truncated, info = self.env.step(action)
        self.steps, self.hits = self.steps + 1, self.hits + info["hit"]
        self.changes += ((info["command"] - self.last) / (2.0 * SPEED)) ** 2
        self.last = info["command"]
        return obs, reward, terminated, truncated, info


def made(missing: str) -> tuple[gymnasium.Env, Protocol]:
    """:return: the environment with all ingredients but one, and its protocol"""
    protocol = Protocol(RailPendulum())
    env = protocol
    if missing != "barrier":
        env = JointLimitBarrier(env, -RAIL, RAIL)
    if missing != "low-pass":
        env = LowPassAction(env, cutoff=3.0)
    env = gymnasium.wrappers.TimeLimit(env, EPISODE)
    return (TruncateToTerminate(env) if missing == "truncation" else env), protocol


def run(missing: str, seed: int, steps: int) -> dict:
    env, protocol = made(missing)
    model = GSDESAC(
        "MlpPolicy",
        env,
        use_sde=missing != "gSDE",
        train_freq=8,
        gradient_steps=8,
        learning_starts=min(400, steps // 4),
        gamma=0.98,
        learning_rate=1e-3,
        policy_kwargs={"net_arch": [64, 64], "log_std_init": -2.0},
        seed=seed,
    )
    model.learn(steps)
    trained = protocol.steps, protocol.hits, protocol.changes
    total, tested = 0.0, made(missing)[0]
    for episode in range(5):
        obs, _ = tested.reset(seed=1000 + episode)
        for _ in range(EPISODE):
            obs, reward, *_ = tested.step(model.predict(obs, deterministic=True)[0])
            total += float(reward)
    return {
        "without": missing or "nothing",
        "seed": seed,
        "steps": steps,
        "return": total / 5,
        "violations": trained[1],
        "continuity": trained[2] / trained[0],
    }


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--steps", type=int, default=6_000)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--without", nargs="*", default=INGREDIENTS, choices=INGREDIENTS)
    parser.add_argument("--folder", type=Path, default=Path("safe_swing_up"))
    arguments = parser.parse_args(words)
    arguments.folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for seed in range(arguments.seeds):
        for missing in ("", *arguments.without):
            rows.append(run(missing, seed, arguments.steps))
            print(rows[-1], flush=True)
            write(rows, arguments.folder)
    show(rows)


def write(rows: list[dict], folder: Path) -> None:
    with (folder / "safe_swing_up.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
    draw(rows, folder / "safe_swing_up.png")


def show(rows: list[dict]) -> None:
    """Means over seeds."""
    print(f"{'without':<12}" + "".join(f"{measure:>14}" for measure in MEASURES))
    for missing in dict.fromkeys(row["without"] for row in rows):
        own = [row for row in rows if row["without"] == missing]
        means = [np.mean([row[measure] for row in own]) for measure in MEASURES]
        print(f"{missing:<12}" + "".join(f"{mean:>14.4g}" for mean in means))


def draw(rows: list[dict], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    labels = ["all", *(f"no {name}" for name in INGREDIENTS)]
    for axes, (measure, title) in zip(figure.subplots(1, 3), MEASURES.items(), strict=True):
        for place, missing in enumerate(("nothing", *INGREDIENTS)):
            values = [row[measure] for row in rows if row["without"] == missing]
            color = "#27496d" if missing == "nothing" else "#9db4c0"
            axes.barh(place, np.mean(values) if values else 0.0, color=color)
            axes.plot(values, [place] * len(values), ".", color="black", markersize=4.0)
        axes.set_yticks(range(len(labels)), labels if measure == "return" else [""] * len(labels))
        axes.invert_yaxis()
        axes.set_title(title, fontsize=10)
        axes.spines[["top", "right"]].set_visible(False)
    n_seeds = len({row["seed"] for row in rows})
    figure.suptitle(f"Rail pendulum, {rows[0]['steps']} steps, {n_seeds} seed(s)", fontsize=11)
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    main()
