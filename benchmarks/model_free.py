"""
The model-free family beside SB3, SB3-contrib and SBX: return against steps and against wall time.

    python benchmarks/model_free.py                                   # Pendulum-v1, five seeds
    python benchmarks/model_free.py --env HalfCheetah-v5 --seeds 2 --methods crossq_jax droq
    python benchmarks/model_free.py --figure

Ours run with their file in `hyperparams/`, the others with what RL Zoo has for SAC, TQC and CrossQ
on that environment (SBX's DroQ: its own documented setting). Each run is a fresh process; training
stops for each evaluation, whose time does not count. On Pendulum-v1, policies start from the 500
states whose best return is known (SB3_HDS_DATA); elsewhere, ten episodes with the same seeds.
Finished runs are kept: an interrupted benchmark goes on where it stopped.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import pandas as pd
import yaml
from pendulum import held_out_states, rollouts
from runs import CACHE, RESULTS, fresh_process, resume

PENDULUM = "Pendulum-v1"
#: steps of a run, and between two evaluations
LENGTHS = {
    PENDULUM: (10_000, 1_000),
    "Hopper-v5": (50_000, 5_000),
    "HalfCheetah-v5": (100_000, 10_000),
}
OURS = ("gsde_sac", "droq", "crossq_jax", "tqc_jax", "simba", "td7", "bro")
#: of each peer: library, class, and what is compared with it
PEERS = {
    "sb3_sac": ("stable_baselines3", "SAC", ("gsde_sac", "simba", "td7", "bro")),
    "contrib_tqc": ("sb3_contrib", "TQC", ("tqc_jax",)),
    "contrib_crossq": ("sb3_contrib", "CrossQ", ("crossq_jax",)),
    "sbx_sac": ("sbx", "SAC", ("gsde_sac", "simba", "td7", "bro")),
    "sbx_tqc": ("sbx", "TQC", ("tqc_jax",)),
    "sbx_crossq": ("sbx", "CrossQ", ("crossq_jax",)),
    "sbx_droq": ("sbx", "SAC", ("droq",)),
}
#: of RL Zoo, where they are not the constructor's defaults
ZOO = {PENDULUM: {"learning_rate": 1e-3}}
DROQ = {
    "policy_kwargs": {"dropout_rate": 0.01, "layer_norm": True},
    "gradient_steps": 20,
    "policy_delay": 20,
}
N_EPISODES = 10
KEYS = ("env", "method", "seed")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--env", default=PENDULUM, choices=list(LENGTHS))
    parser.add_argument("--methods", nargs="*", default=[*OURS, *PEERS])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--figure", action="store_true")
    parser.add_argument("--worker", nargs=3, metavar=("ENV", "METHOD", "SEED"))
    arguments = parser.parse_args()
    if arguments.worker:
        env, method, seed = arguments.worker
        print(json.dumps({"rows": worker(env, method, int(seed))}))
        return
    if not arguments.figure:
        wanted = [
            (arguments.env, method, seed)
            for seed in range(arguments.seeds)
            for method in arguments.methods
        ]
        in_process = lambda *run: fresh_process(__file__, *run, cache=CACHE)["rows"]  # noqa: E731
        resume("model_free", KEYS, wanted, in_process, arguments.jobs)
    report()


def worker(env: str, method: str, seed: int) -> list[dict]:
    """Train; stop the clock and evaluate after every so many steps."""
    model, evaluate = learner(env, method, seed), evaluation(env)
    total, every = LENGTHS[env]
    rows, seconds = [], 0.0
    while model.num_timesteps < total:
        begin = time.perf_counter()
        model.learn(every, reset_num_timesteps=False)
        seconds += time.perf_counter() - begin
        returns = evaluate(model)
        stderr = returns.std() / np.sqrt(len(returns))
        now = {"steps": model.num_timesteps, "seconds": seconds}
        rows.append(now | {"return": returns.mean(), "stderr": stderr})
    return rows


def learner(env: str, method: str, seed: int):
    if method in OURS:
        from sb3_hds import algos

        settings = ours(env, method)
        return algos.ALL[method](env=env, seed=seed, **settings)
    import importlib

    library, name, _ = PEERS[method]
    settings = ZOO.get(env, {}) | (DROQ if method == "sbx_droq" else {})
    if env != PENDULUM:
        settings |= {"learning_starts": 5_000 if method == "sbx_droq" else 10_000}
    algorithm = getattr(importlib.import_module(library), name)
    return algorithm("MlpPolicy", env, seed=seed, **settings)


def ours(env: str, method: str) -> dict:
    path = Path(__file__).parent.parent / "hyperparams" / f"{method}.yml"
    settings = dict(yaml.safe_load(path.read_text())[env])
    settings.pop("n_timesteps")
    return settings


def evaluation(env: str):
    """:return: model to returns, from the same start states for all"""
    if env == PENDULUM:
        angles, speeds, _ = held_out_states()
        return lambda model: rollouts(model, angles, speeds)
    import gymnasium

    def episodes(model) -> np.ndarray:
        system, returns = gymnasium.make(env), []
        for episode in range(N_EPISODES):
            (obs, _), total, over = system.reset(seed=70_000 + episode), 0.0, False
            while not over:
                action, _ = model.predict(obs, deterministic=True)
                obs, reward, terminated, truncated, _ = system.step(action)
                total, over = total + float(reward), terminated or truncated
            returns.append(total)
        return np.array(returns)

    return episodes


def report() -> None:
    path = RESULTS / "model_free.csv"
    if not path.exists():
        print("Nothing has been measured yet.")
        return
    table = pd.read_csv(path)
    last = table.sort_values("steps").groupby(list(KEYS)).tail(1)
    for env, runs in last.groupby("env"):
        print(f"\n{env} after {runs['steps'].max():,} steps")
        summary = runs.groupby("method").agg(
            runs=("return", "size"),
            mean=("return", "mean"),
            worst=("return", "min"),
            best=("return", "max"),
            seconds=("seconds", "mean"),
        )
        print(summary.to_string(float_format="%.1f"))
        figure(table[table["env"] == env], str(env))


def figure(table: pd.DataFrame, env: str) -> None:
    """Return against steps and against wall time; a line for each method, a band over its seeds."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(10.0, 4.0), layout="constrained")
    panels = drawing.subplots(1, 2, sharey=True)
    present = set(table["method"])
    for i, method in enumerate(m for m in (*OURS, *PEERS) if m in present):
        runs = table[table["method"] == method].groupby("steps")
        middle, low, high = (runs["return"].agg(f) for f in ("mean", "min", "max"))
        style = {"color": colormaps["tab10"](i % 10), "linestyle": "-" if method in OURS else "--"}
        seconds = runs["seconds"].mean()
        for panel, x in zip(panels, (middle.index, seconds), strict=True):
            panel.plot(x, middle, label=method, linewidth=1.5, **style)
            panel.fill_between(x, low, high, color=style["color"], alpha=0.12, linewidth=0.0)
    panels[0].set(xlabel="steps in the environment", ylabel=f"return on {env}")
    panels[1].set(xlabel="wall time of training [s]", xscale="log")
    panels[1].legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    drawing.savefig(RESULTS / f"model_free_{env}.png", dpi=150)


if __name__ == "__main__":
    main()
