"""
The range of actions against learning speed and final return: a car on an oval.

    python benchmarks/action_scale.py [--seeds 5] [--steps 6000] [--figure]
    python benchmarks/action_scale.py --steering        # with the full range of speed
    python benchmarks/action_scale.py --wheelbase 0.4   # a car that turns more sharply
    python benchmarks/action_scale.py --steering --wheelbase 0.25 --sde   # persistent noise

Tests what Raffin reports for the steering range of a racing car (*Learning to race in an hour*,
2022). ``ActionScale`` shrinks the range of steering of an understeering car, and that of its target
speed unless ``--steering`` is given, around driving straight ahead at 7 m/s. Each combination of
options has a table of its own. Noise is drawn at every step, or with ``--sde`` lasts for 16 steps
(gSDE, as on the racing car). An episode ends after 20 s or off the track; its return is the
distance covered [m]. The learner is CrossQ with the same settings for all; its mean policy is
evaluated over three episodes.
"""

import argparse
import math

import gymnasium
import numpy as np
from gymnasium import spaces
from runs import CACHE, RESULTS, arguments_of, fresh_process, resume, save

SCALES = (0.4, 0.7, 1.0, "schedule")
#: from 0.4 of the range to the full range over two thirds of the steps
SCHEDULE_SHARE = 2.0 / 3.0
#: distances for which the number of steps is reported [m]
DISTANCES = (100, 140, 160, 180, 200, 220)
_EVERY = 500  # steps, from one evaluation to the next

_DT = 0.1  # [s]
_STEPS = 200
_STRAIGHT, _RADIUS, _HALF_WIDTH = 30.0, 8.0, 2.0  # [m]
_WHEELBASE = 1.0  # [m]
_UNDERSTEER = 0.01  # [s2/m2]
_STEERING = 0.5  # [rad]
_SPEEDS = 2.0, 12.0  # [m/s]
_ACCELERATION = 6.0  # [m/s2]
_SIGHT = (0.0, 3.0, 6.0, 12.0)  # [m]


class Oval(gymnasium.Env):
    """
    A car in the coordinates of the middle line of an oval: place along it, distance to its left,
    heading against it. Kinematic, with a yaw rate that understeer takes away at speed:

    ``yaw rate = v tan(steering) / (L (1 + K v^2))``
    """

    dt = _DT

    def __init__(self, wheelbase: float = _WHEELBASE) -> None:
        self.wheelbase = wheelbase
        self.observation_space = spaces.Box(-5.0, 5.0, (3 + len(_SIGHT),))
        self.action_space = spaces.Box(-1.0, 1.0, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        place = self.np_random.uniform(0.0, _length())
        offset, heading = self.np_random.uniform(-0.5, 0.5), self.np_random.uniform(-0.1, 0.1)
        self.state, self.n_steps = (place, offset, heading, float(np.mean(_SPEEDS))), 0
        return self._observe(), {}

    def step(self, action):
        steering, throttle = np.clip(action, -1.0, 1.0) * (_STEERING, 1.0)
        place, offset, heading, speed = self.state
        wanted = np.mean(_SPEEDS) + throttle * 0.5 * (_SPEEDS[1] - _SPEEDS[0])
        most = _ACCELERATION * _DT
        speed += np.clip(wanted - speed, -most, most)
        turn = speed * math.tan(steering) / (self.wheelbase * (1.0 + _UNDERSTEER * speed**2))
        bend = curvature(place)
        progress = speed * math.cos(heading) / (1.0 - offset * bend)
        offset += speed * math.sin(heading) * _DT
        heading += (turn - bend * progress) * _DT
        self.state = ((place + progress * _DT) % _length(), offset, heading, float(speed))
        self.n_steps += 1
        off = abs(offset) > _HALF_WIDTH or abs(heading) > 0.5 * math.pi
        return self._observe(), progress * _DT, bool(off), self.n_steps >= _STEPS, {}

    def _observe(self):
        place, offset, heading, speed = self.state
        ahead = [curvature(place + d) * _RADIUS for d in _SIGHT]
        seen = [offset / _HALF_WIDTH, heading, (speed - 7.0) / 5.0, *ahead]
        return np.clip(seen, -5.0, 5.0).astype(np.float32)


def curvature(place: float) -> float:
    """:return: of the middle line, a bend to the left [1/m]"""
    along = place % (0.5 * _length())
    return 0.0 if along < _STRAIGHT else 1.0 / _RADIUS


def _length() -> float:
    return 2.0 * _STRAIGHT + 2.0 * math.pi * _RADIUS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=6_000)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--figure", action="store_true")
    parser.add_argument("--wheelbase", type=float, default=_WHEELBASE, help="of the car [m]")
    parser.add_argument("--steering", action="store_true", help="shrink only its range")
    parser.add_argument("--sde", action="store_true", help="noise that lasts for 16 steps")
    arguments = arguments_of(parser, worker)
    table = table_of(arguments.wheelbase, arguments.steering, arguments.sde)
    if not arguments.figure:
        wanted = [(seed, arguments.steps) for seed in range(arguments.seeds)]
        given = arguments.wheelbase, int(arguments.steering), int(arguments.sde)
        work = lambda *run: fresh_process(__file__, *run, *given, cache=CACHE)  # noqa: E731
        resume(table, ["seed", "steps"], wanted, work, arguments.jobs)
    report(arguments.steps, table)
    for scale in SCALES[:-1]:
        steps = steps_at_random(float(scale), arguments.wheelbase, axes_of(arguments.steering))
        print(f"random actions, {scale} of the range: on the track for {steps:.1f} steps")


def worker(seed: int, steps: int, wheelbase: float, steering: int, sde: int) -> list[dict]:
    given = seed, steps, wheelbase, axes_of(bool(steering)), bool(sde)
    return [row for scale in SCALES for row in learn(str(scale), *given)]


def axes_of(steering: bool) -> list[int] | None:
    """:return: actions whose range is scaled; None: all"""
    return [0] if steering else None


def steps_at_random(
    scale: float, wheelbase: float, axes: list[int] | None, n_episodes: int = 200
) -> float:
    """:return: mean length of episodes with actions that are drawn anew at every step"""
    from sb3_hds.wrappers import ActionScale

    env, steps = ActionScale(Oval(wheelbase), scale, axes=axes), 0
    env.action_space.seed(0)
    for episode in range(n_episodes):
        env.reset(seed=episode)
        done = False
        while not done:
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            steps, done = steps + 1, terminated or truncated
    return steps / n_episodes


def table_of(wheelbase: float, steering: bool, sde: bool) -> str:
    """:return: name of the table"""
    parts = ["action_scale"]
    parts += ["steering"] * steering
    parts += [f"wheelbase_{wheelbase:g}"] * (wheelbase != _WHEELBASE)
    return "_".join(parts + ["sde"] * sde)


def learn(
    scale: str,
    seed: int,
    steps: int,
    wheelbase: float = _WHEELBASE,
    axes: list[int] | None = None,
    sde: bool = False,
) -> list[dict]:
    """:return: one row for each evaluation"""
    from sb3_hds import CrossQ
    from sb3_hds.wrappers import ActionScale

    def wrapped():
        if scale != "schedule":
            return ActionScale(Oval(wheelbase), float(scale), axes=axes)
        schedule = [[0, 0.4], [SCHEDULE_SHARE * steps, 1.0]]
        return ActionScale(Oval(wheelbase), schedule=schedule, axes=axes)

    noise = {"use_sde": True, "sde_sample_freq": 16, "use_sde_at_warmup": True} if sde else {}
    log_std = {"log_std_init": -1.0} if sde else {}
    model = CrossQ(
        "MlpPolicy",
        wrapped(),
        learning_starts=500,
        train_freq=50,
        gradient_steps=25,
        batch_size=128,
        policy_delay=3,
        policy_kwargs={"net_arch": {"pi": [64, 64], "qf": [128, 128]}} | log_std,
        gamma=0.97,
        seed=seed,
        **noise,
    )
    rows, env = [], wrapped()
    while model.num_timesteps < steps:
        model.learn(_EVERY, reset_num_timesteps=not rows)
        env.set_progress(model.num_timesteps / (SCHEDULE_SHARE * steps))
        distance, finished = evaluate(model, env, 1000 + seed)
        point = {"timestep": model.num_timesteps, "distance": distance, "finished": finished}
        rows.append({"scale": scale} | point)
    return rows


def evaluate(model, env, seed: int, n_episodes: int = 3) -> tuple[float, float]:
    """:return: mean distance of episodes [m], and the share of them that stayed on the track"""
    covered, finished = 0.0, 0
    for episode in range(n_episodes):
        obs, _ = env.reset(seed=seed + episode)
        done = False
        while not done:
            action, _ = model.predict(obs, deterministic=True)
            obs, reward, terminated, truncated, _ = env.step(action)
            covered, done = covered + reward, terminated or truncated
        finished += truncated and not terminated
    return covered / n_episodes, finished / n_episodes


def report(steps: int, name: str = "action_scale") -> None:
    """Print and draw the runs of so many steps: those of other lengths have another schedule."""
    import pandas as pd

    table = pd.read_csv(RESULTS / f"{name}.csv", dtype={"scale": str})
    table = table[table.steps == steps]
    if table.empty:
        print(f"{RESULTS / name}.csv has no runs of {steps} steps.")
        return
    grouped = table.groupby(["scale", "timestep"]).distance.agg(["mean", "std", "count"])
    print(grouped.round(1).to_string())
    rows = reached(table)
    print(save(rows, f"{name}_reached").to_string(index=False))
    draw(table, name)


def reached(table) -> list[dict]:
    """:return: for each range, the steps until distances are first reached, and the last one"""
    rows, farthest = [], table.distance.max()
    for scale, own in table.groupby("scale"):
        row = {"scale": scale, "seeds": own.seed.nunique()}
        for distance in (d for d in DISTANCES if d < farthest):
            first = own[own.distance >= distance].groupby("seed").timestep.min()
            all_did = len(first) == row["seeds"]
            row[f"steps to {distance} m"] = f"{first.mean():.0f}" if all_did else "-"
        last = own[own.timestep == own.timestep.max()].distance
        row["distance at the end [m]"] = f"{last.mean():.0f} +- {last.std():.0f}"
        rows.append(row)
    return rows


def draw(table, name: str) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0, 3.6), layout="constrained")
    axes = figure.subplots()
    for scale, color in zip(map(str, SCALES), ("#4c956c", "#27496d", "#b8422e", "#888888")):  # noqa: B905
        own = table[table.scale == scale]
        runs = own.pivot(index="timestep", columns="seed", values="distance")
        if runs.empty:
            continue
        mean, error = runs.mean(1), runs.std(1) / np.sqrt(runs.count(1))
        axes.plot(mean.index, mean, color=color, label=scale)
        axes.fill_between(mean.index, mean - error, mean + error, color=color, alpha=0.2, lw=0.0)
    axes.set_xlabel("steps of the environment")
    axes.set_ylabel("distance in 20 s [m]")
    axes.set_title(f"Share of the action range, {table.seed.nunique()} seeds, mean and its error")
    axes.legend(frameon=False, title="ActionScale")
    figure.savefig(RESULTS / f"{name}.png", dpi=150)


if __name__ == "__main__":
    main()
