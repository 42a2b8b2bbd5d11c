"""
Pendulum-v1 from a cold start: HDS, SB3's SAC and SBX's SAC, each in fresh processes.

    python benchmarks/pendulum.py            # five seeds of HDS, one of each SAC
    python benchmarks/pendulum.py --figure   # redraw the figure from the tables

Snapshots of every policy are taken during training and evaluated afterwards on 500 start states
whose best reachable return is known (SB3_HDS_DATA). These states are drawn afresh and exclude rows
0, 16, 32, ..., on which the defaults were tuned. Regret is the mean over these states of the best
return minus the return.
"""

import argparse
import os
import sys
from pathlib import Path

import numpy as np
import pandas as pd
from runs import RESULTS, arguments_of, fresh_process, save, seconds_since_start

PEERS = {"sb3_sac": 20_000, "sbx_sac": 20_000}
TARGETS = (-150.0, -145.0, -140.0)
N_STATES, N_STEPS = 500, 200


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--figure", action="store_true")
    arguments = arguments_of(parser, worker)
    if not arguments.figure:
        run(arguments.seeds)
    report()


def run(n_seeds: int) -> None:
    jobs = [("hds", seed) for seed in range(n_seeds)] + [(peer, 0) for peer in PEERS]
    held_out_states()  # raises before any run if the data are missing
    curves, finals = [], []
    for name, seed in jobs:
        print(f"{name}, seed {seed} ...", file=sys.stderr, flush=True)
        result = fresh_process(__file__, name, seed)
        curves += [{"algorithm": name, "seed": seed, **point} for point in result["curve"]]
        finals.append({"algorithm": name, "seed": seed, **result["final"]})
        save(curves, "pendulum_curves")
        save(finals, "pendulum")


def worker(name: str, seed: int) -> dict:
    """Train once, keep snapshots with the time they were taken, then evaluate them."""
    train = {"hds": train_hds, "sb3_sac": train_sb3_sac, "sbx_sac": train_sbx_sac}[name]
    snapshots, restore = train(seed)
    angles, speeds, best = held_out_states()
    curve = []
    for seconds, steps, weights in snapshots:
        returns = rollouts(restore(weights), angles, speeds)
        regret = best - returns
        curve.append(
            {
                "seconds": seconds,
                "real_steps": steps,
                "return": returns.mean(),
                "regret": regret.mean(),
                "regret_stderr": regret.std() / np.sqrt(len(regret)),
            }
        )
    final = dict(curve[-1])
    for target in TARGETS:
        reached = [point["seconds"] for point in curve if point["return"] >= target]
        final[f"seconds_to_{target:g}"] = reached[0] if reached else None
    return {"curve": curve, "final": final}


def train_hds(seed: int):
    """The default call, with a snapshot after every tenth planning epoch."""
    from sb3_hds import HDS

    class Watched(HDS):
        def run_epoch(self, gradient_steps):
            report = super().run_epoch(gradient_steps)
            if int(self.policy.progress.n_epochs) % 10 == 0:
                snapshots.append((seconds_since_start(), self.num_timesteps, self.policy.networks))
            return report

    snapshots = []
    model = Watched("Pendulum-v1", seed=seed)
    model.learn()
    snapshots.append((seconds_since_start(), model.num_timesteps, model.policy.networks))

    def restore(networks):
        model.policy.networks = networks
        return model

    return snapshots, restore


def train_sb3_sac(seed: int):
    """With the zoo's settings for Pendulum-v1: defaults but for the learning rate."""
    from stable_baselines3 import SAC

    model = SAC("MlpPolicy", "Pendulum-v1", learning_rate=1e-3, seed=seed)

    def copy():
        return {key: value.clone() for key, value in model.policy.state_dict().items()}

    def restore(weights):
        model.policy.load_state_dict(weights)
        return model

    return watched(model, PEERS["sb3_sac"], copy), restore


def train_sbx_sac(seed: int):
    from sbx import SAC

    model = SAC("MlpPolicy", "Pendulum-v1", learning_rate=1e-3, seed=seed)

    def restore(state):
        model.policy.actor_state = state
        return model

    return watched(model, PEERS["sbx_sac"], lambda: model.policy.actor_state), restore


def watched(model, total_timesteps: int, copy):
    """Train; a snapshot every 500 real steps."""
    from stable_baselines3.common.callbacks import BaseCallback

    class Watch(BaseCallback):
        def _on_step(self) -> bool:
            if self.n_calls % 500 == 0:
                snapshots.append((seconds_since_start(), self.num_timesteps, copy()))
            return True

    snapshots = []
    model.learn(total_timesteps, callback=Watch())
    return snapshots


def held_out_states():
    """:return: angles [rad], speeds [rad/s] and best returns of 500 states not used in tuning"""
    folder = os.environ.get("SB3_HDS_DATA")
    if folder is None:
        raise SystemExit(
            "Set SB3_HDS_DATA to the folder with pendulum_optimum/pendulum_v1_optimum.npz."
        )
    table = np.load(Path(folder, "pendulum_optimum", "pendulum_v1_optimum.npz"))
    unseen = np.setdiff1d(np.arange(len(table["R"])), np.arange(0, len(table["R"]), 16))
    rows = np.random.default_rng(2026).choice(unseen, N_STATES, replace=False)
    return table["t"][rows], table["w"][rows], table["R"][rows]


def rollouts(model, angle, speed) -> np.ndarray:
    """Pendulum-v1's own equations in NumPy float64, all start states at once."""
    angle, speed, total = angle.copy(), speed.copy(), np.zeros(len(angle))
    for _ in range(N_STEPS):
        obs = np.stack([np.cos(angle), np.sin(angle), speed], 1).astype(np.float32)
        torque = np.clip(model.predict(obs, deterministic=True)[0][:, 0].astype(float), -2.0, 2.0)
        wrapped = (angle + np.pi) % (2.0 * np.pi) - np.pi
        total -= wrapped**2 + 0.1 * speed**2 + 0.001 * torque**2
        speed = np.clip(speed + (15.0 * np.sin(angle) + 3.0 * torque) * 0.05, -8.0, 8.0)
        angle = angle + 0.05 * speed
    return total


def report() -> None:
    finals = pd.read_csv(RESULTS / "pendulum.csv")
    print(finals.to_string(index=False, float_format="%.2f"))
    ours = finals[finals.algorithm == "hds"]
    print(
        f"\nHDS, {len(ours)} seeds: return {ours['return'].mean():.2f}, regret "
        f"{ours.regret.mean():.2f} (worst seed {ours.regret.max():.2f}), "
        f"{ours.seconds.mean():.1f} s (slowest {ours.seconds.max():.1f} s)"
    )
    for peer in PEERS:
        theirs = finals[finals.algorithm == peer]["seconds_to_-150"].iloc[0]
        ratio = theirs / ours["seconds_to_-150"].mean()
        print(f"time to -150: {peer} {theirs:.1f} s, {ratio:.1f} times that of HDS")
    figure()


def figure() -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    curves = pd.read_csv(RESULTS / "pendulum_curves.csv")
    labels = {"hds": "HDS", "sb3_sac": "SAC (SB3)", "sbx_sac": "SAC (SBX)"}
    fig, axes = plt.subplots(1, 2, figsize=(10, 4), sharey=True)
    for axis, x, label in (
        (axes[0], "seconds", "wall time from process start [s]"),
        (axes[1], "real_steps", "steps in the environment"),
    ):
        for i, (name, runs) in enumerate(curves.groupby("algorithm", sort=False)):
            for j, (_, one) in enumerate(runs.groupby("seed")):
                axis.plot(one[x], one["return"], color=f"C{i}", label=None if j else labels[name])
        best = (curves["return"] + curves["regret"]).mean()
        axis.axhline(best, color="0.5", linestyle=":", label="best reachable")
        axis.set(xlabel=label, ylim=(-220, -130))
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("mean return, 500 start states")
    axes[0].legend(loc="lower right")
    fig.tight_layout()
    fig.savefig(RESULTS / "pendulum.png", dpi=120)


if __name__ == "__main__":
    main()
