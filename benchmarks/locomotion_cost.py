"""
The cost of MuJoCo's engine inside compiled programs, beside that of the engine alone.

    python benchmarks/locomotion_cost.py

HalfCheetah-v5 and other tasks of Gymnasium in the middle of random motion. A control interval is
several steps of the engine. Times are the smallest of several repetitions, in microseconds for each
interval: of the engine called from NumPy, of the twin in a scan at batch 1 (a callback each), in a
batch, and with its derivatives; ``overhead_us`` is what a callback costs besides the engine. Other
work on the machine makes all of them longer, so the load is in the table.
"""

import argparse
import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from runs import save

TASKS = ("HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Ant-v5", "Swimmer-v5", "Reacher-v5")
N_SCANNED, N_BATCH, N_REPEATED = 500, 256, 7


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--tasks", nargs="*", default=TASKS)
    rows = []
    for env_id in parser.parse_args().tasks:
        rows.append(measured(env_id))
        table = save(rows, "locomotion_cost")
    print(table.to_string(index=False, float_format="%.1f"))


def measured(env_id: str) -> dict[str, Any]:
    """:return: a row of the table"""
    import jax
    import jax.numpy as jnp

    from sb3_hds import twins

    twin, load = twins.make(env_id), os.getloadavg()[0]
    states = in_motion(twin)
    n_act = len(twin.actuators)
    idle = jnp.zeros(n_act)

    @jax.jit
    def scanned(state):
        stay = lambda s, _: (twin.step(s, idle, twin.params), None)  # noqa: E731
        return jax.lax.scan(stay, state, None, length=N_SCANNED)[0]

    def after(state, change):
        moved = twin.retract(state, change[:-n_act])
        return twin.difference(twin.step(moved, change[-n_act:], twin.params), state)

    zero = jnp.zeros(len(twin.difference(first(states), first(states))) + n_act)
    steps = jax.jit(jax.vmap(lambda s: twin.step(s, idle, twin.params)))
    linear = jax.jit(jax.vmap(lambda s: jax.jacfwd(lambda z: after(s, z))(zero)))
    one = seconds(lambda: scanned(first(states))) / N_SCANNED
    raw = seconds(lambda: raw_steps(twin, first(states), N_SCANNED)) / N_SCANNED
    return {
        "task": env_id,
        "engine_steps": twin.substeps,
        "engine_us": 1e6 * raw,
        "callback_us": 1e6 * one,
        "overhead_us": 1e6 * (one - raw),
        "in_a_batch_us": 1e6 * seconds(lambda: steps(states)) / N_BATCH,
        "linearised_us": 1e6 * seconds(lambda: linear(states)) / N_BATCH,
        "columns": len(zero),
        "processors": len(os.sched_getaffinity(0)),
        "other_load": load,
    }


def in_motion(twin) -> Any:
    """:return: states of random motions, a batch"""
    import jax

    keys = jax.random.split(jax.random.key(0), N_BATCH)
    states = jax.vmap(twin.initial, (0, None))(keys, twin.params)
    step = jax.jit(jax.vmap(lambda s, u: twin.step(s, u, twin.params)))
    for _ in range(10):
        key, _ = jax.random.split(keys[0])
        actions = jax.random.uniform(key, (N_BATCH, len(twin.actuators)), minval=-1.0)
        states = step(states, actions)
    return states


def first(states: Any) -> Any:
    import jax

    return jax.tree.map(lambda leaf: leaf[0], states)


def raw_steps(twin, state, n: int) -> None:
    """The same steps without JAX: ``mj_step`` in a loop, from the same state."""
    import mujoco

    model = twin.model
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = np.asarray(state.q), np.asarray(state.v)
    for _ in range(n):
        mujoco.mj_step(model, data, twin.substeps)


def seconds(call: Callable[[], Any]) -> float:
    """:return: of one call, the least of a few"""
    import jax

    jax.block_until_ready(call())
    taken = []
    for _ in range(N_REPEATED):
        begin = time.perf_counter()
        jax.block_until_ready(call())
        taken.append(time.perf_counter() - begin)
    return min(taken)


if __name__ == "__main__":
    main()
