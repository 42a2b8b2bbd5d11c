"""
The price of smooth exploration: return against continuity cost, for white noise and gSDE.

    python benchmarks/gsde_continuity.py                 # two environments, three seeds
    python benchmarks/gsde_continuity.py --figure        # redraw the figure from the table

After figure 2 of Raffin, Kober and Stulp, *Smooth Exploration for Robotic Reinforcement Learning*,
CoRL 2021. The learner is always GSDESAC, with as many updates after each episode as it had steps,
so that only the noise differs: drawn at every step independently of the state, or computed from
features of the state by a matrix that lasts for 2, 8, 64 steps or a whole episode. The continuity
cost is that of the paper, 100 times the mean square of the change between successive actions as a
share of their range: 0 for a constant action, 100 for one that jumps from end to end. It is
measured during learning, from the first update on, and for the mean policy that is evaluated.
Finished runs are kept.
"""

import argparse
from functools import partial

import gymnasium
import numpy as np
import pandas as pd
from runs import CACHE, RESULTS, arguments_of, fresh_process, resume, seconds_since_start

#: steps of a run, by environment; all their episodes have the same length
LENGTHS = {"Pendulum-v1": 10_000, "HalfCheetah-v5": 50_000}
#: number of steps between new noise matrices of gSDE; None: unstructured noise
NOISES = {"unstructured": None, "gSDE 2": 2, "gSDE 8": 8, "gSDE 64": 64, "gSDE episode": -1}
SETTINGS = {
    "Pendulum-v1": {"learning_starts": 500, "learning_rate": 1e-3},
    "HalfCheetah-v5": {"learning_starts": 5_000},
}
N_EPISODES = 20
KEYS = ("env", "noise", "seed")


class Continuity(gymnasium.Wrapper):
    """Keeps the square of each change of the action, as a share of its range."""

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        self.changes: list[float] = []
        self._last: np.ndarray | None = None

    def reset(self, **arguments):
        self._last = None
        return self.env.reset(**arguments)

    def step(self, action):
        share = action / (self.action_space.high - self.action_space.low)
        if self._last is not None:
            self.changes.append(float(np.mean((share - self._last) ** 2)))
        self._last = share
        return self.env.step(action)

    def cost(self) -> float:
        return 100.0 * float(np.mean(self.changes))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--envs", nargs="*", default=list(LENGTHS))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--figure", action="store_true")
    arguments = arguments_of(parser, worker)
    if not arguments.figure:
        wanted = [
            (env_id, noise, seed)
            for env_id in arguments.envs
            for seed in range(arguments.seeds)
            for noise in NOISES
        ]
        in_process = partial(fresh_process, __file__, cache=CACHE)
        resume("gsde_continuity", KEYS, wanted, in_process, arguments.jobs)
    report()


def worker(env_id: str, noise: str, seed: int) -> dict:
    from sb3_hds import GSDESAC
    from sb3_hds.experiments import returns_of

    env = Continuity(gymnasium.make(env_id))
    stays, settings = NOISES[noise], SETTINGS[env_id]
    model = GSDESAC(
        "MlpPolicy",
        env,
        seed=seed,
        train_freq=(1, "episode"),
        gradient_steps=-1,
        use_sde=stays is not None,
        sde_sample_freq=stays or -1,
        **settings,
    )
    model.learn(settings["learning_starts"])
    env.changes.clear()
    model.learn(LENGTHS[env_id] - model.num_timesteps, reset_num_timesteps=False)
    seconds = seconds_since_start()
    judged = Continuity(gymnasium.make(env_id))
    returns = returns_of(model, judged, N_EPISODES)
    return {
        "return": returns.mean(),
        "continuity": env.cost(),
        "continuity_of_mean": judged.cost(),
        "seconds": seconds,
    }


def report() -> None:
    table = pd.read_csv(RESULTS / "gsde_continuity.csv")
    measured = ["return", "continuity", "continuity_of_mean"]
    summary = table.groupby(["env", "noise"], sort=False)[measured].agg(["mean", "min", "max"])
    print(summary.to_string(float_format="%.2f"))
    figure(table)


def figure(table: pd.DataFrame) -> None:
    """A panel for each environment: a point for each seed, a cross at their mean."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    shown = [env_id for env_id in LENGTHS if (table["env"] == env_id).any()]
    drawing = Figure(figsize=(4.0 * len(shown), 3.4), layout="constrained")
    for axes, env_id in zip(drawing.subplots(1, len(shown), squeeze=False)[0], shown, strict=True):
        for i, noise in enumerate(NOISES):
            runs = table[(table["env"] == env_id) & (table["noise"] == noise)]
            colour = colormaps["viridis"](i / len(NOISES))
            axes.plot(runs["continuity"], runs["return"], "o", color=colour, alpha=0.4)
            middle = runs[["continuity", "return"]].mean()
            axes.plot(*middle, "X", color=colour, markersize=9, label=noise)
        costs = table.loc[table["env"] == env_id, "continuity"]
        scale = "log" if costs.max() > 3.0 * costs.min() else "linear"
        axes.set(xlabel="continuity cost while learning", title=env_id, xscale=scale)
        axes.spines[["top", "right"]].set_visible(False)
    drawing.axes[0].set_ylabel("return of the mean policy")
    drawing.axes[0].legend(frameon=False, fontsize=8)
    drawing.savefig(RESULTS / "gsde_continuity.png", dpi=150)


if __name__ == "__main__":
    main()
