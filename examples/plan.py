"""
Watch model-predictive control in a twin act in its environment, without any learning.

    python examples/plan.py HalfCheetah-v5 --horizon 20 --replan-every 2
    python examples/plan.py HalfCheetah-v5 --horizon 20 --replan-every 2 --human
    python examples/plan.py Hopper-v5 --horizon 60 --video videos

A window needs a display, a video the extra ``zoo`` and a renderer (``MUJOCO_GL=egl`` without a
display).
"""

import argparse
import time

import gymnasium
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from sb3_hds import planning, twins


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("env", help="id of an environment that has a twin")
    parser.add_argument("--episodes", type=int, default=1)
    parser.add_argument("--horizon", type=int, help="steps of a plan; default: one second")
    parser.add_argument("--replan-every", type=int, default=1, help="steps that are executed")
    parser.add_argument("--iterations", type=int, default=3, help="improvements of each plan")
    parser.add_argument("--steps", type=int, help="end each episode after so many")
    parser.add_argument("--seed", type=int, default=0)
    shown = parser.add_mutually_exclusive_group()
    shown.add_argument("--human", action="store_true", help="show a window")
    shown.add_argument("--video", metavar="FOLDER", help="write videos")
    given = parser.parse_args()
    mode = "human" if given.human else "rgb_array" if given.video else None
    env = gymnasium.make(given.env, render_mode=mode, max_episode_steps=given.steps)
    policy = planning.mpc(
        twins.from_env(env),
        horizon=given.horizon,
        replan_every=given.replan_every,
        n_iterations=given.iterations,
        seed=given.seed,
    )
    if given.video:
        every = lambda _: True  # noqa: E731
        env = gymnasium.wrappers.RecordVideo(env, given.video, episode_trigger=every)
    env = Monitor(env)
    env.reset(seed=given.seed)
    begin = time.perf_counter()
    returns, lengths = evaluate_policy(policy, env, given.episodes, return_episode_rewards=True)
    env.close()
    for earned, length in zip(returns, lengths, strict=True):
        print(f"return {earned:.1f} in {length} steps")
    print(f"{time.perf_counter() - begin:.0f} s, compilation included")


if __name__ == "__main__":
    main()
