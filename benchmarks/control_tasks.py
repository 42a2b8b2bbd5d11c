"""
HDS with default arguments on six control tasks: return in the environment, and wall time.

    python benchmarks/control_tasks.py [--seeds 3]

Each run is a fresh process with an empty compilation cache; its time counts from the start of the
interpreter to the end of ``HDS(env_id).learn()``. The policy is then evaluated over 100 episodes of
the environment as ``gymnasium.make`` makes it, with the same resets for every seed.
"""

import argparse
import sys

import numpy as np
from runs import arguments_of, fresh_process, save, seconds_since_start

# What counts as solved. CartPoleSwingUp: see `upright`.
TASKS = {
    "sb3_hds/CartPoleSwingUp-v0": None,
    "InvertedPendulum-v5": 1000.0,
    "InvertedDoublePendulum-v5": 9300.0,
    "MountainCarContinuous-v0": 93.0,
    "sb3_hds/AcrobotContinuous-v0": None,
    "sb3_hds/PayloadPendulum-v0": None,
}
N_EPISODES = 100


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--tasks", nargs="*", default=list(TASKS))
    arguments = arguments_of(parser, worker)
    rows = []
    for env_id in arguments.tasks:
        for seed in range(arguments.seeds):
            print(f"{env_id}, seed {seed} ...", file=sys.stderr, flush=True)
            rows.append({"env": env_id, "seed": seed, **fresh_process(__file__, env_id, seed)})
            table = save(rows, "control_tasks")
    print(table.to_string(index=False, float_format="%.2f"))


def worker(env_id: str, seed: int) -> dict:
    from sb3_hds import HDS

    model = HDS(env_id, seed=seed)
    model.learn()
    seconds = seconds_since_start()
    returns, upright = evaluate(model, env_id)
    target = TASKS[env_id]
    return {
        "return": returns.mean(),
        "stderr": returns.std() / np.sqrt(len(returns)),
        "worst": returns.min(),
        "target": target,
        "reached": None if target is None else bool(returns.mean() >= target),
        "upright_at_end": upright,
        "seconds": seconds,
        "real_steps": model.num_timesteps,
        "twin_steps": model.twin_timesteps,
    }


def evaluate(model, env_id: str) -> tuple[np.ndarray, float | None]:
    """Returns of fixed episodes; for the cart-pole also how many end balanced."""
    import gymnasium

    env = gymnasium.make(env_id)
    returns, ends = [], []
    for episode in range(N_EPISODES):
        obs, _ = env.reset(seed=10_000 + episode)
        total, over, path = 0.0, False, []
        while not over:
            obs, reward, terminated, truncated, _ = env.step(model.predict(obs)[0])
            total, over = total + float(reward), terminated or truncated
            path.append(obs)
        returns.append(total)
        ends.append(np.array(path[-50:]))
    upright = share_upright(ends) if env_id == "sb3_hds/CartPoleSwingUp-v0" else None
    return np.array(returns), upright


def share_upright(ends: list[np.ndarray]) -> float:
    """Share of episodes that stay within 0.1 rad and 0.2 m of the goal for their last second."""
    good = [np.all(np.abs(e[:, 0]) < 0.2) and np.all(e[:, 1] > np.cos(0.1)) for e in ends]
    return float(np.mean(good))


if __name__ == "__main__":
    main()
