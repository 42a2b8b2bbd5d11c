"""
The gap between simulation and reality, and who closes it with how many real steps.

    python benchmarks/sim_to_real.py                       # all cells and methods, five seeds
    python benchmarks/sim_to_real.py --cells heavy --seeds 2
    python benchmarks/sim_to_real.py --figure              # draw the figure again from the table

Each cell is a stand-in for hardware that its data sheet describes wrongly. Wrong twin, HDS and
domain randomisation know the data sheet; the ceiling is PODS on the true twin. Every policy is
evaluated on the same 50 start states of the real system. Finished runs are kept in the table: an
interrupted benchmark goes on where it stopped. Only cells whose gap (ceiling minus wrong twin) is
above three standard errors count.
"""

import argparse
import json
import sys

import numpy as np
import pandas as pd
from runs import RESULTS, fresh_process, save, seconds_since_start

PENDULUM, CART = "sb3_hds/PendulumReal-v1", "sb3_hds/InvertedPendulumFriction-v5"
EPISODE, SWING_UP = 200, 250
CELLS = {
    "light": (PENDULUM, {"mass": 0.75}),
    "heavy": (PENDULUM, {"mass": 1.25}),
    "short": (PENDULUM, {"length": 0.5}),
    "long": (PENDULUM, {"length": 1.5}),
    "heavy, long": (PENDULUM, {"mass": 1.25, "length": 1.25}),
    "heavy, long, noise 0.1": (PENDULUM, {"mass": 1.25, "length": 1.25, "noise": 0.1}),
    "heavy, long, noise 0.2": (PENDULUM, {"mass": 1.25, "length": 1.25, "noise": 0.2}),
    "friction": (PENDULUM, {"friction": 0.3, "noise": 0.01}),
    "drag": (PENDULUM, {"drag": 0.04, "noise": 0.01}),
    "delay": (PENDULUM, {"delay": 0.1, "noise": 0.01}),
    "cart friction": (CART, {"hinge_friction": 2.0, "slider_friction": 20.0, "swing_up": True}),
}
METHODS = ("ceiling", "wrong_twin", "randomised", "hds", "sac", "tqc", "droq")
STEPS = (1, 5, 10)  # real episodes after which learners are evaluated
N_STARTS = 50


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--cells", nargs="*", default=list(CELLS))
    parser.add_argument("--methods", nargs="*", default=list(METHODS))
    parser.add_argument("--figure", action="store_true")
    parser.add_argument("--worker", nargs=3, metavar=("CELL", "METHOD", "SEED"))
    arguments = parser.parse_args()
    if arguments.worker:
        cell, method, seed = arguments.worker
        print(json.dumps(worker(cell, method, int(seed))))
        return
    if not arguments.figure:
        run(arguments.cells, arguments.methods, arguments.seeds)
    report()


def run(cells: list[str], methods: list[str], n_seeds: int) -> None:
    path = RESULTS / "sim_to_real.csv"
    rows = pd.read_csv(path).to_dict("records") if path.exists() else []
    done = {(row["cell"], row["method"], row["seed"]) for row in rows}
    for seed in range(n_seeds):
        for cell in cells:
            for method in methods:
                if (cell, method, seed) in done:
                    continue
                print(f"{cell}, {method}, seed {seed} ...", file=sys.stderr, flush=True)
                found = fresh_process(__file__, cell, method, seed)["rows"]
                key = {"cell": cell, "method": method, "seed": seed}
                rows += [key | row for row in found]
                save(rows, "sim_to_real")


def worker(cell: str, method: str, seed: int) -> dict:
    """Train once; evaluate after each number of real episodes."""
    env_id, settings = CELLS[cell]
    env = make(env_id, settings)
    length = SWING_UP if env_id == CART else EPISODE
    if method in ("ceiling", "wrong_twin", "randomised"):
        model = planner(method, env, env_id, settings, seed).learn(0)
        return {"rows": [evaluated(model, env_id, settings, 0)]}
    model = learner(method, env, env_id, settings, seed)
    rows = []
    for episodes in STEPS:
        model.learn(episodes * length - model.num_timesteps, reset_num_timesteps=False)
        rows.append(evaluated(model, env_id, settings, episodes))
    return {"rows": rows}


def make(env_id: str, settings: dict):
    import gymnasium

    import sb3_hds  # noqa: F401

    limit = {"max_episode_steps": SWING_UP} if env_id == CART else {}
    return gymnasium.make(env_id, **settings, **limit)


def data_sheet(env_id: str):
    """The twin as its maker describes the system: nothing of what is hidden."""
    from sb3_hds import twins

    return twins.make(env_id, **({"swing_up": True} if env_id == CART else {}))


def planner(method: str, env, env_id: str, settings: dict, seed: int):
    from sb3_hds import HDS, envs

    twin = envs.true_twin(env) if method == "ceiling" else data_sheet(env_id)
    spread = 1.0 if method == "randomised" else 0.0
    # HDS that never sees data is PODS with the same planning settings as HDS beside it.
    return HDS(env, twin=twin, refit_freq=0, randomisation=spread, seed=seed)


def learner(method: str, env, env_id: str, settings: dict, seed: int):
    if method == "hds":
        from sb3_hds import HDS

        return HDS(env, twin=data_sheet(env_id), seed=seed).learn(0)
    from sbx import SAC, TQC

    rates = {"learning_rate": 1e-3}
    if method == "sac":
        return SAC("MlpPolicy", env, seed=seed, **rates)
    if method == "tqc":
        return TQC("MlpPolicy", env, seed=seed, **rates)
    # DroQ (Hiraoka et al. 2022): dropout, layer norm and 20 gradient steps for each real one.
    nets = {"dropout_rate": 0.01, "layer_norm": True}
    return SAC(
        "MlpPolicy", env, seed=seed, gradient_steps=20, policy_delay=20, policy_kwargs=nets, **rates
    )


def evaluated(model, env_id: str, settings: dict, episodes: int) -> dict:
    seconds, env, returns = seconds_since_start(), make(env_id, settings), []
    for start in range(N_STARTS):
        obs, _ = env.reset(seed=50_000 + start)
        total, over = 0.0, False
        while not over:
            obs, reward, terminated, truncated, _ = env.step(
                model.predict(obs, deterministic=True)[0]
            )
            total, over = total + float(reward), terminated or truncated
        returns.append(total)
    return {
        "episodes": episodes,
        "real_steps": model.num_timesteps,
        "return": float(np.mean(returns)),
        "seconds": seconds,
    }


def report() -> None:
    table = pd.read_csv(RESULTS / "sim_to_real.csv")
    shown = closed(table)
    shown.to_csv(RESULTS / "sim_to_real_gap.csv", index=False, float_format="%.4g")
    print(shown.to_string(index=False, float_format="%.2f"))
    counted = shown[shown["counts"]]
    for (method, episodes), group in counted.groupby(["method", "episodes"]):
        share = group["closed"].median()
        print(f"{method} after {episodes} episodes: {share:.2f} of the gap (median of cells)")
    figure(shown)


def closed(table: pd.DataFrame) -> pd.DataFrame:
    """The share of each cell's gap that a method closes, over the seeds that all have."""
    rows = []
    for cell, group in table.groupby("cell", sort=False):
        by_seed = group.pivot_table("return", "seed", ["method", "episodes"])
        if ("ceiling", 0) not in by_seed or ("wrong_twin", 0) not in by_seed:
            continue
        gaps = (by_seed["ceiling", 0] - by_seed["wrong_twin", 0]).dropna()
        stderr = gaps.std(ddof=1) / np.sqrt(len(gaps)) if len(gaps) > 1 else np.nan
        for method, episodes in by_seed.columns:
            values = by_seed[method, episodes].dropna()
            share = (values - by_seed["wrong_twin", 0]).mean() / gaps.mean()
            rows.append(
                {
                    "cell": cell,
                    "method": method,
                    "episodes": episodes,
                    "return": values.mean(),
                    "closed": share,
                    "gap": gaps.mean(),
                    "gap_stderr": stderr,
                    "counts": bool(gaps.mean() > 3.0 * stderr),
                    "seeds": len(values),
                }
            )
    return pd.DataFrame(rows)


def figure(shown: pd.DataFrame) -> None:
    """Return against real episodes, a panel for each cell."""
    from matplotlib.figure import Figure

    cells = list(dict.fromkeys(shown["cell"]))
    columns = min(4, len(cells))
    lines = -(-len(cells) // columns)
    drawing = Figure(figsize=(3.2 * columns, 2.6 * lines), layout="constrained")
    panels = drawing.subplots(lines, columns, squeeze=False).ravel()
    styles = {"hds": "#27496d", "sac": "#d1495b", "tqc": "#edae49", "droq": "#66a182"}
    for panel, cell in zip(panels, cells, strict=False):
        group = shown[shown["cell"] == cell]
        for method, style in (("ceiling", "-"), ("randomised", ":"), ("wrong_twin", "--")):
            for value in group[group["method"] == method]["return"]:
                panel.axhline(value, color="#9a978c", linestyle=style, label=method)
        for method, colour in styles.items():
            rows = group[group["method"] == method]
            panel.plot(rows["episodes"], rows["return"], "o-", color=colour, label=method)
        panel.set_title(cell, fontsize=9)
        panel.set_xlabel("real episodes", fontsize=8)
        panel.tick_params(labelsize=8)
    for panel in panels[len(cells) :]:
        panel.set_visible(False)
    panels[0].set_ylabel("return on the real system", fontsize=8)
    panels[0].legend(fontsize=6, frameon=False)
    drawing.savefig(RESULTS / "sim_to_real.png", dpi=150)


if __name__ == "__main__":
    main()
