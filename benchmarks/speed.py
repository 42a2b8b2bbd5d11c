"""
Steps and updates per second of the model-free algorithms, compared with SBX, SB3 and SB3-Contrib.

    python benchmarks/speed.py                     # all rows; resumable
    python benchmarks/speed.py --rows "droq, 20" "droq, 1, start-up"
    python benchmarks/speed.py --table
    python benchmarks/speed.py --on cuda --jobs 4  # rows of a GPU, in a table of their own

Pendulum-v1 with equal networks, batches and replay ratios. Two learners alternate in one process,
in short blocks, so that a slow moment of the machine affects both; the speed-up is the median ratio
over pairs of neighbouring blocks, with its quartiles. The start-up is that of a fresh process, from
the interpreter to the first update, with an empty compilation cache.

Two more kinds of rows have no peer: `learn_compiled`, with environment and updates in one program
and several seeds side by side; and `products`, the matrix products of SAC's update with these
networks and this batch alone, compiled and timed in alternation with the complete update, which no
code around them can save.

A second table has the gain of SBX over SB3, computed from both comparisons. It is reported to be up
to twenty times, and depends on the number of updates per step.
"""

import argparse
import os
import sys
import time

import numpy as np
import pandas as pd
from runs import (
    CACHE,
    RESULTS,
    arguments_of,
    fresh_process,
    others_waiting,
    resume,
    seconds_since_start,
)

ENV, BATCH, STARTS = "Pendulum-v1", 256, 100
WIDE = {"pi": [256, 256], "qf": [1024, 1024]}
#: our class, its peer, and the arguments of both
PAIRS = {
    "sac": ("GSDESAC", {"use_sde": False}, "SAC", {}),
    "gsde_sac": ("GSDESAC", {"policy_kwargs": {"log_std_init": -3.0}}, "SAC", {"use_sde": True}),
    "droq": (
        "DroQ",
        {},
        "SAC",
        {"policy_kwargs": {"dropout_rate": 0.01, "layer_norm": True}},
    ),
    "tqc": ("TQC", {"policy_kwargs": {"n_critics": 2}}, "TQC", {}),
    "crossq": (
        "CrossQ",
        {"policy_kwargs": {"net_arch": WIDE}},
        "CrossQ",
        {"policy_kwargs": {"net_arch": WIDE}},
    ),
    "simba": (
        "SimbaSAC",
        {"policy": "SimbaPolicy", "policy_kwargs": {"net_arch": {"pi": [128], "qf": [256, 256]}}},
        "SAC",
        {"policy": "SimbaPolicy", "policy_kwargs": {"net_arch": {"pi": [128], "qf": [256, 256]}}},
    ),
}
#: what SB3 and SB3-contrib have of these
IN_SB3 = ("sac", "gsde_sac", "tqc", "crossq")
#: without a peer: their own speed
ALONE = {"td7": ("TD7", {"use_checkpoints": False}), "bro": ("BRO", {})}
RATIOS = (1, 20)
N_BLOCKS = 9
#: approximate duration of a block of the slower of two learners [s]
BLOCK_S = {"cpu": 3.0, "cuda": 0.5}
SEEDS = (1, 2, 4, 8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--rows", nargs="*", help='such as "droq, 20, sbx"; default: all')
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--on", default="cpu", choices=list(BLOCK_S))
    parser.add_argument("--jobs", type=int, default=1, help="one measures, the others compile")
    arguments = arguments_of(parser, worker)
    on = arguments.on
    platforms = on if on == "cpu" else f"{on},cpu"
    os.environ |= {"JAX_PLATFORMS": platforms, "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    name = "speed" if on == "cpu" else f"speed_{on}"
    if not arguments.table:
        wanted = [run for run in rows(on) if chosen(run, arguments.rows)]
        in_process = lambda *run: fresh_process(__file__, *run, cache=cache_of(run))  # noqa: E731
        resume(name, ("name", "ratio", "peer"), wanted, in_process, arguments.jobs)
    report(name)


def rows(on: str) -> list[tuple[str, int, str]]:
    pairs = [(name, ratio, "sbx") for name in PAIRS for ratio in RATIOS]
    pairs += [(name, ratio, "sb3") for name in IN_SB3 for ratio in RATIOS]
    pairs += [(name, ratio, "none") for name in ALONE for ratio in RATIOS]
    compiled = [("sac", n_seeds, "compiled") for n_seeds in SEEDS]
    if on != "cpu":
        return pairs + compiled
    pairs += [("sac", ratio, "products") for ratio in RATIOS]
    starts = [(name, 1, f"start-up of {who}") for name in PAIRS for who in ("ours", "sbx")]
    return pairs + compiled + starts


def chosen(run: tuple[str, int, str], words: list[str] | None) -> bool:
    label = ", ".join(map(str, run))
    return words is None or any(label.startswith(word) for word in words)


def cache_of(run: tuple[str, int, str]):
    """Start-ups are measured with an empty compilation cache."""
    return None if "start-up" in run[2] else CACHE


def worker(name: str, ratio: int, peer: str) -> dict:
    if peer.startswith("start-up"):
        return {"start_up_s": start_up(name, peer.split()[-1])}
    if peer == "compiled":
        return compiled(name, ratio)
    models = [ours(name, ratio)] + ([] if peer == "none" else [other(name, ratio, peer)])
    for model in models:
        model.learn(STARTS + 20)
    with others_waiting():
        steps = block_length(models)
        seconds = np.array([turn(models, steps, backwards=bool(i % 2)) for i in range(N_BLOCKS)])
    middle = np.median(seconds, 0)
    row = {"steps_per_s": steps / middle[0], "updates_per_s": steps * ratio / middle[0]}
    if peer != "none":
        low, faster, high = np.quantile(seconds[:, 1] / seconds[:, 0], (0.25, 0.5, 0.75))
        row |= {"peer_steps_per_s": steps / middle[1]}
        row |= {"speed_up": faster, "low": low, "high": high}
    return row


def block_length(models: list) -> int:
    """:return: number of steps for which the slower learner needs about ``BLOCK_S``"""
    slowest = max(turn(models, 10, backwards=False)) / 10
    return int(np.clip(BLOCK_S[device()] / slowest, 5, 500))


def device() -> str:
    """:return: name of the device that all learners use"""
    return os.environ["JAX_PLATFORMS"].partition(",")[0]


def turn(models: list, steps: int, backwards: bool) -> list[float]:
    """:return: seconds of each learner, run one after the other"""
    seconds = [0.0] * len(models)
    order = range(len(models))
    for i in reversed(order) if backwards else order:
        begin = time.perf_counter()
        models[i].learn(steps, reset_num_timesteps=False)
        seconds[i] = time.perf_counter() - begin
    return seconds


def ours(name: str, ratio: int):
    import sb3_hds

    algorithm, arguments, *_ = PAIRS[name] if name in PAIRS else ALONE[name]
    return getattr(sb3_hds, algorithm)(**common(name, ratio), **arguments)


def other(name: str, ratio: int, library: str):
    """:param library: ``"sbx"``, ``"sb3"`` for SB3 and SB3-contrib, or ``"products"``"""
    if library == "products":
        return Products(ratio)
    _, _, algorithm, arguments = PAIRS[name]
    settings = common(name, ratio) | {"policy": "MlpPolicy"} | arguments
    if library == "sbx":
        import sbx

        return getattr(sbx, algorithm)(**settings)
    import sb3_contrib
    import stable_baselines3
    import torch

    torch.set_num_threads(2)
    found = getattr(stable_baselines3, algorithm, None) or getattr(sb3_contrib, algorithm)
    return found(**settings, device=device())


class Products:
    """
    The matrix products of SAC's updates and nothing else, called as a model is.

    Of a layer from 256 units to as many, for a batch of as many: twice forward in the actor and
    once back, to its input and to its weights; in both critics, forward in the targets, forward
    and back twice, once of these to the weights. Layers of few inputs or outputs are left out.
    Matrices are orthogonal, so that numbers keep their size.
    """

    def __init__(self, ratio: int) -> None:
        import jax
        from jax import lax

        normal = np.random.default_rng(0).normal(size=(3, BATCH, BATCH))
        one, *two = np.linalg.qr(normal)[0].astype(np.float32)
        pair = np.stack(two)

        def update(_, carry):
            actor, critics = carry
            actor = actor @ one
            critics = critics @ pair
            critics = critics @ pair
            critics = critics @ pair.swapaxes(1, 2)
            critics = critics.swapaxes(1, 2) @ pair
            actor = actor @ one
            critics = critics @ pair
            critics = critics @ pair.swapaxes(1, 2)
            actor = actor @ one.T
            actor = actor.T @ one
            return actor, critics

        self._carry = (one, pair)
        self._updates = jax.jit(lambda carry: lax.fori_loop(0, ratio, update, carry))

    def learn(self, total_timesteps: int, **_) -> None:
        for _ in range(total_timesteps):
            self._carry = self._updates(self._carry)
        self._carry[0].block_until_ready()


def common(name: str, ratio: int) -> dict:
    """Equal for all; DroQ updates its actor once for each call of ``train``."""
    settings = {"env": ENV, "batch_size": BATCH, "learning_starts": STARTS, "seed": 0}
    settings |= {"train_freq": 1, "gradient_steps": ratio}
    return settings | ({"policy_delay": ratio} if name == "droq" else {})


def start_up(name: str, who: str) -> float:
    """:return: seconds from the start of the interpreter to the end of the first update"""
    model = ours(name, 1) if who == "ours" else other(name, 1, "sbx")
    model.learn(STARTS + 2)
    return seconds_since_start()


def compiled(name: str, n_seeds: int) -> dict:
    """Steps per second of all seeds together, compilation excluded."""
    from sb3_hds.algos import learn_compiled

    model, steps = ours(name, 1), 2_000
    learn_compiled(model, steps, range(n_seeds))
    with others_waiting():
        begin = time.perf_counter()
        learn_compiled(model, steps, range(n_seeds))
        seconds = time.perf_counter() - begin
    made = {"steps_per_s": steps, "updates_per_s": steps - STARTS}
    return {name: n_seeds * each / seconds for name, each in made.items()}


def report(name: str) -> None:
    """
    :param name: of the table of all rows, with which those of others made from it begin
    """
    path = RESULTS / f"{name}.csv"
    if not path.exists():
        print("Nothing has been measured yet.", file=sys.stderr)
        return
    measured = pd.read_csv(path)
    tables = {
        "targets": beside_targets(measured),
        "sbx_sb3": sbx_beside_sb3(measured),
        "start_up": start_ups(measured),
        "products": products(measured),
        "alone": alone(measured),
    }
    print(measured.to_string(index=False, float_format="%.3g"))
    for part, table in tables.items():
        if len(table):
            table.to_csv(RESULTS / f"{name}_{part}.csv", index=False, float_format="%.4g")
            print(f"\n{table.to_string(index=False, float_format='%.3g')}")


def target(ratio: int, peer: str) -> float:
    """:return: target of the speed-up"""
    if peer == "sb3":
        return 3.0
    return 1.3 if ratio == 20 else 1.0


def beside_targets(measured: pd.DataFrame) -> pd.DataFrame:
    """:return: a row for each pair, with the target of its speed-up"""
    pairs = measured[measured["peer"].isin(("sbx", "sb3"))]
    pairs = pairs[["name", "ratio", "peer", "speed_up", "low", "high"]].copy()
    pairs["target"] = [target(*pair) for pair in pairs[["ratio", "peer"]].itertuples(index=False)]
    pairs["reached"] = np.where(pairs["speed_up"] >= pairs["target"], "yes", "no")
    return pairs


def sbx_beside_sb3(measured: pd.DataFrame) -> pd.DataFrame:
    """:return: speed-up of SBX over SB3, the quotient of our speed-ups over both"""
    wide = measured.pivot_table("speed_up", ["name", "ratio"], "peer").reindex(
        columns=["sbx", "sb3"]
    )
    found = (wide["sb3"] / wide["sbx"]).dropna()
    return found.rename("sbx_times_sb3").reset_index()


def products(measured: pd.DataFrame) -> pd.DataFrame:
    """:return: share of the matrix products in the time of a complete step"""
    rows = measured[measured["peer"] == "products"]
    return rows[["name", "ratio", "speed_up", "low", "high"]].rename(
        columns={"speed_up": "share_of_products"}
    )


def start_ups(measured: pd.DataFrame) -> pd.DataFrame:
    """:return: seconds to the first update, of each pair"""
    if "start_up_s" not in measured:
        return pd.DataFrame()
    wide = measured.pivot_table("start_up_s", "name", "peer")
    wide = wide.rename(columns=lambda peer: peer.removeprefix("start-up of ") + "_s")
    return wide.assign(speed_up=wide["sbx_s"] / wide["ours_s"]).reset_index()


def alone(measured: pd.DataFrame) -> pd.DataFrame:
    """:return: rows without a peer; for the compiled path, ``ratio`` is the number of seeds"""
    rows = measured[measured["peer"].isin(("none", "compiled"))]
    return rows[["name", "ratio", "peer", "steps_per_s", "updates_per_s"]]


if __name__ == "__main__":
    main()
