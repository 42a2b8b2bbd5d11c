"""
Returns of planning in receding horizon on tasks with contacts, without any learning.

    python benchmarks/locomotion.py
    python benchmarks/locomotion.py --tasks HalfCheetah-v5 --episodes 3

``planning.mpc`` with the settings of ``SETTINGS`` acts in Gymnasium's environments, evaluated by
SB3's ``evaluate_policy``; one fresh process for each episode. Wall time includes imports and
compilation. Finished episodes are kept.
"""

import argparse
import os
import time
from pathlib import Path
from typing import Any

from runs import RESULTS, arguments_of, fresh_process, save

SETTINGS: dict[str, dict[str, Any]] = {
    "HalfCheetah-v5": {"horizon": 20, "replan_every": 2},
    "Hopper-v5": {"horizon": 60, "replan_every": 4},
    "Walker2d-v5": {"horizon": 60, "replan_every": 4},
    "Ant-v5": {"horizon": 15, "replan_every": 2, "n_iterations": 2},
    "Swimmer-v5": {"horizon": 40, "replan_every": 4},
    "Reacher-v5": {"horizon": 25, "replan_every": 1},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--tasks", nargs="*", default=list(SETTINGS))
    parser.add_argument("--episodes", type=int, default=1, help="of each task")
    given = arguments_of(parser, worker)
    rows = finished()
    for episode in range(given.episodes):
        for task in given.tasks:
            same = {"task": task, "episode": episode, "settings": described(task)}
            if any(all(row[name] == x for name, x in same.items()) for row in rows):
                continue
            print(f"{task}, episode {episode} ...", flush=True)
            rows = [r for r in rows if (r["task"], r["episode"]) != (task, episode)]
            rows.append(same | fresh_process(__file__, task, episode))
            save(rows, "locomotion")
    print(save(rows, "locomotion").to_string(index=False, float_format="%.1f"))


def finished() -> list[dict[str, Any]]:
    import pandas as pd

    path = Path(RESULTS, "locomotion.csv")
    return pd.read_csv(path).to_dict("records") if path.exists() else []


def described(task: str) -> str:
    return " ".join(f"{name}={value}" for name, value in SETTINGS[task].items())


def worker(task: str, episode: int) -> dict[str, Any]:
    import gymnasium
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.monitor import Monitor

    from sb3_hds import planning, twins

    load, begin = os.getloadavg()[0], time.time()
    env = Monitor(gymnasium.make(task))
    env.reset(seed=episode)
    policy = planning.mpc(twins.from_env(env), seed=episode, **SETTINGS[task])
    returns, lengths = evaluate_policy(policy, env, 1, return_episode_rewards=True)
    taken = time.time() - begin
    return {
        "return": returns[0],
        "steps": lengths[0],
        "wall_s": taken,
        "ms_per_step": 1e3 * taken / lengths[0],
        "processors": len(os.sched_getaffinity(0)),
        "other_load": load,
    }


if __name__ == "__main__":
    main()
