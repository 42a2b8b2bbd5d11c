"""
Time per step of the learners of ``model_free.py``, alternating in one process.

    taskset -c 0 python benchmarks/model_free_pace.py                       # Pendulum-v1
    taskset -c 0 python benchmarks/model_free_pace.py --env HalfCheetah-v5 --methods sac td7

Runs of ``model_free.py`` are days apart, and a shared machine is twice as fast on one day as on
another: the same run took 37 s and 94 s. The wall times of its tables are therefore computed from
the number of steps and the times measured here: the seconds of the first block of steps with
updates, with an empty compilation cache, and the median time of a step in further blocks. Learners
alternate, so that a slow moment affects all. Evaluation does not count. New measurements replace
old ones; learners that are compared with each other should come from one run.
"""

import argparse
import time
from typing import Any

import model_free
import numpy as np
import pandas as pd
from model_free import LENGTHS, ONLY_ON, OURS, PEERS, PENDULUM
from runs import RESULTS, arguments_of, fresh_process, save

#: steps of a block: a whole episode of Pendulum-v1, since some learn when one has ended
BLOCK = 200
N_BLOCKS = 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--env", default=PENDULUM, choices=list(LENGTHS))
    parser.add_argument("--methods", nargs="*", choices=[*OURS, *PEERS], default=[*OURS, *PEERS])
    arguments = arguments_of(parser, worker)
    env = arguments.env
    methods = [name for name in arguments.methods if env in ONLY_ON.get(name, LENGTHS)]
    rows = fresh_process(__file__, env, ",".join(methods))
    path = RESULTS / "model_free_pace.csv"
    before = pd.read_csv(path).to_dict("records") if path.exists() else []
    kept = [row for row in before if row["env"] != env or row["method"] not in methods]
    print(save(kept + rows, path.stem).to_string(index=False, float_format="%.4g"))


def worker(env: str, methods: str) -> list[dict[str, Any]]:
    """
    :param methods: separated by commas
    :return: a row for each method
    """
    names = methods.split(",")
    learners = [model_free.learner(env, method, seed=0) for method in names]
    first = [turn(learner, getattr(learner, "learning_starts", 0) + BLOCK) for learner in learners]
    further = np.array([[turn(learner, BLOCK) for learner in learners] for _ in range(N_BLOCKS)])
    paces = further[..., 1] / further[..., 0]
    return [
        {
            "env": env,
            "method": method,
            "first_steps": first[i][0],
            "first_s": first[i][1],
            "step_s": np.median(paces[:, i]),
            "fastest_step_s": paces[:, i].min(),
            "slowest_step_s": paces[:, i].max(),
        }
        for i, method in enumerate(names)
    ]


def turn(learner: Any, steps: int) -> tuple[int, float]:
    """:return: steps that it made, which may be more, and their seconds"""
    before, begin = learner.num_timesteps, time.perf_counter()
    learner.learn(steps, reset_num_timesteps=False)
    return learner.num_timesteps - before, time.perf_counter() - begin


if __name__ == "__main__":
    main()
