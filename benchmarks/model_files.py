"""
The cost of a twin from a model file, against the number of joints and of rows.

    python benchmarks/model_files.py
    python benchmarks/model_files.py --joints 1 7 30 --rows 64
    python benchmarks/model_files.py --report-only

The models are arms of 1 to 30 hinges with MuJoCo's implicitfast integrator at 2 ms, in double
precision. A row is a state with a command; its cost is that of a step, or of a step with its
derivatives by state and command. Each number of joints is a fresh process with an empty compilation
cache on one core; the fastest of five calls counts, in processor time. A step of the C engine is
measured for comparison.
"""

import argparse
import os
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from runs import RESULTS, arguments_of, fresh_process, resume

JOINTS = (1, 2, 4, 7, 12, 20, 30)
ROWS = (64, 1024)
_CALLS = 5
_ENGINE_STEPS = 2000
_AXES = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0", "0 1 0")
_ONE_CORE = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument("--joints", nargs="*", type=int, default=list(JOINTS))
    parser.add_argument("--rows", nargs="*", type=int, default=list(ROWS))
    parser.add_argument("--report-only", action="store_true")
    arguments = arguments_of(parser, worker)
    if not arguments.report_only:
        os.environ["XLA_FLAGS"] = _ONE_CORE
        wanted = [(n, rows) for n in arguments.joints for rows in arguments.rows]
        resume("model_files", ("joints", "rows"), wanted, partial(fresh_process, __file__), jobs=1)
    print(pd.read_csv(RESULTS / "model_files.csv").to_string(index=False, float_format="%.3g"))


def arm(joints: int) -> str:
    """:return: MJCF of a chain of hinges about changing axes, with a motor each"""
    bodies, drives = "", ""
    for i in range(joints):
        bodies += f"""<body pos="0 0 {0.2 if i else 0}"><joint name="j{i}" axis="{_AXES[i % 7]}"
          damping="0.1" armature="0.01"/><geom type="capsule" fromto="0 0 0 0.01 0 0.2"
          size="0.03"/>"""
        drives += f'<motor name="m{i}" joint="j{i}"/>'
    return f"""<mujoco><option timestep="0.002" integrator="implicitfast"/>
      <default><geom contype="0" conaffinity="0"/></default>
      <worldbody>{bodies}{"</body>" * joints}</worldbody><actuator>{drives}</actuator></mujoco>"""


def worker(joints: int, rows: int) -> dict:
    import jax
    import jax.numpy as jnp
    import mujoco

    from sb3_hds import twins
    from sb3_hds.core import State

    jax.config.update("jax_enable_x64", True)
    twin = twins.from_mujoco(arm(joints))
    params = {name: jnp.asarray(value) for name, value in twin.values.items()}
    rng = np.random.default_rng(0)
    x, u = (jnp.asarray(rng.normal(size=(rows, n))) for n in (2 * joints, joints))

    def step(x: jax.Array, u: jax.Array) -> jax.Array:
        after = twin.step(State(x[:joints], x[joints:], {}), u, params)
        return jnp.concatenate([after.q, after.v])

    found: dict = {}
    for name, function in (("step", step), ("linearisation", jax.jacfwd(step, (0, 1)))):
        begin = time.process_time()
        compiled = jax.jit(jax.vmap(function)).lower(x, u).compile()
        found[f"compile {name} [s]"] = time.process_time() - begin
        found[f"{name} [us a row]"] = 1e6 * fastest(lambda f=compiled: f(x, u)) / rows
    model = mujoco.MjModel.from_xml_string(arm(joints))
    data = mujoco.MjData(model)
    found["C engine [us a step]"] = (
        1e6 * fastest(lambda: [mujoco.mj_step(model, data) for _ in range(_ENGINE_STEPS)])
    ) / _ENGINE_STEPS
    return found


def fastest(call: Callable[[], Any]) -> float:
    """:return: processor time of one call [s]"""
    import jax

    jax.block_until_ready(call())
    best = np.inf
    for _ in range(_CALLS):
        begin = time.process_time()
        jax.block_until_ready(call())
        best = min(best, time.process_time() - begin)
    return best


if __name__ == "__main__":
    main()
