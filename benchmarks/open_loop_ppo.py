"""
Open-loop gaits compared with PPO after a million steps: the figure of the open-loop paper.

    python benchmarks/open_loop.py --steps 1000000     # the gaits
    python benchmarks/open_loop_ppo.py                 # PPO and random actions, five seeds
    python benchmarks/open_loop_ppo.py --figure        # redraw the figure from the tables

PPO is SBX's, with RL Zoo's hyperparameters for these environments and its normalisation of
observations and rewards. Its final policy is evaluated on the same 20 resets as the gaits. In the
figure, a score of 0 is the return of random actions in an environment and 1 the mean of PPO's
seeds; over all environments there are interquartile means with 95 % bootstrap intervals that
resample seeds within each environment, as recommended by Agarwal et al. 2021. Finished runs are
kept.
"""

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from intervals import of_iqm
from open_loop import N_EPISODES, TARGETS
from runs import CACHE, RESULTS, arguments_of, fresh_process, resume, save, seconds_since_start

_KEYS = ("env", "learner", "seed", "steps")
_COLOURS = {"open loop": "#27496d", "ppo": "#d1495b"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--envs", nargs="*", default=list(TARGETS))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--figure", action="store_true")
    arguments = arguments_of(parser, worker)
    if not arguments.figure:
        wanted = [
            (env_id, learner, seed, steps)
            for seed in range(arguments.seeds)
            for learner, steps in (("random", 0), ("ppo", arguments.steps))
            for env_id in arguments.envs
        ]
        work = partial(fresh_process, __file__, cache=CACHE / "programs")
        resume("open_loop_ppo", _KEYS, wanted, work, arguments.jobs)
    report(arguments.steps)


def worker(env_id: str, learner: str, seed: int, steps: int) -> dict:
    """Learn once, then evaluate the policy."""
    import gymnasium

    from sb3_hds.experiments import returns_of

    env = gymnasium.make(env_id)
    model = RandomActions(env, seed) if learner == "random" else Normalised(env_id, seed, steps)
    seconds = seconds_since_start()
    returns = returns_of(model, env, N_EPISODES)
    return {"return": returns.mean(), "std": returns.std(), "seconds": seconds}


class RandomActions:
    def __init__(self, env: Any, seed: int) -> None:
        self.space = env.action_space
        self.space.seed(seed)

    def predict(self, *_: Any, **__: Any) -> tuple[np.ndarray, None]:
        return self.space.sample(), None


class Normalised:
    """A trained PPO with the normalisation statistics of its observations."""

    def __init__(self, env_id: str, seed: int, steps: int) -> None:
        from sbx import PPO
        from stable_baselines3.common.env_util import make_vec_env
        from stable_baselines3.common.vec_env import VecNormalize

        settings = hyperparameters(env_id)
        envs = make_vec_env(env_id, settings.pop("n_envs", 1), seed=seed)
        self.envs = VecNormalize(envs, gamma=settings.get("gamma", 0.99))
        self.model = PPO("MlpPolicy", self.envs, seed=seed, **settings).learn(steps)

    def predict(self, obs: np.ndarray, *_: Any, **__: Any) -> tuple[np.ndarray, None]:
        normalised = self.envs.normalize_obs(obs)
        return self.model.predict(normalised, deterministic=True)[0], None


def hyperparameters(env_id: str) -> dict[str, Any]:
    """:return: hyperparameters of RL Zoo for the version of the environment that it has"""
    import flax.linen as nn
    import rl_zoo3
    import yaml

    path = Path(rl_zoo3.__file__).parent / "hyperparams" / "ppo.yml"
    entry = yaml.safe_load(path.read_text())[env_id.replace("-v5", "-v4")]
    found = {k: v for k, v in entry.items() if k not in ("normalize", "n_timesteps", "policy")}
    if "policy_kwargs" in found:
        # Always the same text there, made for torch.
        found["policy_kwargs"] = {
            "log_std_init": -2,
            "activation_fn": nn.relu,
            "net_arch": {"pi": [256, 256], "vf": [256, 256]},
        }
    return found


def report(steps: int) -> None:
    """Print, save and plot the scores."""
    peers = pd.read_csv(RESULTS / "open_loop_ppo.csv")
    gaits = pd.read_csv(RESULTS / "open_loop.csv")
    gaits = gaits[gaits.steps == steps].assign(learner="open loop")
    ppo = peers[(peers.learner == "ppo") & (peers.steps == steps)]
    random = peers[peers.learner == "random"].groupby("env")["return"].mean()
    both = pd.concat([gaits, ppo])
    whole = ppo.groupby("env")["return"].mean() - random
    both["score"] = (both["return"] - both.env.map(random)) / both.env.map(whole)
    both = both.dropna(subset=["score"])
    rows = summary(both, random)
    save(rows, "open_loop_scores")
    print(pd.DataFrame(rows).to_string(index=False, float_format="%.2f"))
    draw(both, rows, steps)


def summary(both: pd.DataFrame, random: pd.Series) -> list[dict[str, Any]]:
    """:return: for each environment and for all of them: returns and scores of both"""
    rows = []
    for env_id in [*(e for e in TARGETS if (both.env == e).any()), "all"]:
        row: dict[str, Any] = {"env": env_id, "random": random.get(env_id)}
        for learner in _COLOURS:
            own = both[both.learner == learner]
            own = own if env_id == "all" else own[own.env == env_id]
            if own.empty:
                continue
            score, low, high = of_iqm([group.to_numpy() for _, group in own.groupby("env").score])
            row |= {
                f"return of {learner}": None if env_id == "all" else own["return"].mean(),
                f"score of {learner}": score,
                f"95 % interval of {learner}": f"{low:.2f} to {high:.2f}",
                f"seeds of {learner}": own.groupby("env").seed.nunique().min(),
            }
        rows.append(row)
    return rows


def draw(both: pd.DataFrame, rows: list[dict[str, Any]], steps: int) -> None:
    """Scores by environment, a dot for each seed, and the interquartile means of all."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 3.6), layout="constrained")
    axes = figure.subplots()
    places = {row["env"]: place for place, row in enumerate(rows)}
    for learner, shift in zip(_COLOURS, (-0.14, 0.14), strict=True):
        own, colour = both[both.learner == learner], _COLOURS[learner]
        axes.plot(own.env.map(places) + shift, own.score, "o", color=colour, alpha=0.45)
        for row in rows:
            if f"score of {learner}" not in row:
                continue
            place, score = places[row["env"]] + shift, row[f"score of {learner}"]
            low, high = map(float, row[f"95 % interval of {learner}"].split(" to "))
            label = learner if row is rows[0] else None
            axes.plot(place + np.array([-0.1, 0.1]), [score] * 2, color=colour, lw=2.5, label=label)
            axes.plot([place] * 2, [low, high], color=colour, lw=1)
    axes.axhline(1.0, color="0.6", lw=0.8, ls="--", zorder=0)
    axes.axhline(0.0, color="0.6", lw=0.8, ls=":", zorder=0)
    axes.set_xticks(list(places.values()), [name.removesuffix("-v5") for name in places])
    axes.set_ylabel(f"score after {steps:,} steps")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    figure.savefig(RESULTS / "open_loop_scores.png", dpi=150)


if __name__ == "__main__":
    main()
