"""
Returns under sensor noise, sensor failure and pushes: open-loop gaits and learned policies.

    python benchmarks/robustness.py                                 # published gaits
    python benchmarks/robustness.py --learners sac --steps 200000   # and a learner

The gaits are those that the authors of the open-loop paper published, in two variants: with
encoders of their own, as on a robot, and with joint controllers that use the observation. Learners
are ids of this package, or SBX's ``sac`` and ``ppo``. Each policy runs from the same starts under
each perturbation. Finished runs are kept.
"""

import argparse
from functools import partial

import numpy as np
from runs import CACHE, RESULTS, arguments_of, fresh_process, resume

TAU = 2.0 * np.pi
#: the constants that the paper's authors published, in rad and rad/s
GAITS = {
    "Swimmer-v5": {
        "amplitude": 1.0,
        "phase": [0.0, TAU * 0.95],
        "omega_swing": TAU * 0.62,
        "omega_stance": TAU * 0.62,
        "kp": 10.0,
        "kd": 0.5,
    },
    "HalfCheetah-v5": {
        "amplitude": [1.123, -1.910, -1.204, 1.173, 1.196, -0.085],
        "offset": [-0.114, 0.075, 0.002, -0.493, -0.501, -0.227],
        "phase": [TAU * turns for turns in (0.0, 0.789, 0.316, 0.294, 0.629, 0.921)],
        "omega_swing": TAU * 3.865,
        "omega_stance": TAU * 4.622,
        "kp": 1.0,
        "kd": 0.05,
    },
}
#: source of the joint states that a gait tracks
ENCODERS = {"gait": "own", "gait, joints observed": "observation"}
_SEED = 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--envs", nargs="*", default=list(GAITS))
    parser.add_argument("--learners", nargs="*", default=[])
    parser.add_argument("--steps", type=int, default=200_000, help="that a learner has")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--jobs", type=int, default=1)
    arguments = arguments_of(parser, worker)
    learned = [f"{name}, {arguments.steps:,} steps" for name in arguments.learners]
    wanted = [
        (env_id, policy, arguments.episodes)
        for policy in (*ENCODERS, *learned)
        for env_id in arguments.envs
    ]
    work = partial(fresh_process, __file__, cache=CACHE)
    resume("robustness", ["env", "policy", "episodes"], wanted, work, arguments.jobs)
    report()


def worker(env_id: str, policy: str, episodes: int) -> list[dict]:
    """:return: one row for each perturbation"""
    from sb3_hds import OpenLoop
    from sb3_hds.experiments import measure_robustness

    if policy in ENCODERS:
        model = OpenLoop("MlpPolicy", env_id, seed=_SEED).set_constants(**GAITS[env_id])
    else:
        name, _, steps = policy.partition(", ")
        n_steps = int(steps.removesuffix(" steps").replace(",", ""))
        model = algorithm(name)("MlpPolicy", env_id, seed=_SEED).learn(n_steps)
    encoders = ENCODERS.get(policy, "own")
    found = measure_robustness(model, env_id, n_episodes=episodes, encoders=encoders)
    return found.to_rows()


def algorithm(name: str):
    """:return: one of ours by its id, or SBX's"""
    import sbx

    from sb3_hds import algos

    return algos.ALL.get(name) or {"sac": sbx.SAC, "ppo": sbx.PPO}[name]


def report() -> None:
    import pandas as pd

    table = pd.read_csv(RESULTS / "robustness.csv")
    shares = table.pivot(index="perturbation", columns=["env", "policy"], values="share")
    print(shares.to_string(float_format="%.2f"))


if __name__ == "__main__":
    main()
