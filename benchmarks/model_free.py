"""
Model-free algorithms compared with SB3, SB3-Contrib and SBX: return against steps and wall time.

    python benchmarks/model_free.py                                   # Pendulum-v1, five seeds
    python benchmarks/model_free.py --env MountainCarContinuous-v0 --seeds 2 --methods td7 bro
    python benchmarks/model_free.py --figure                          # rebuild tables and figures

Ours run with their file in `hyperparams/`, the others with RL Zoo's hyperparameters of SAC, TQC and
CrossQ for that environment (those of -v4 for -v5; SBX's DroQ: those of SAC with its documented
arguments; SB3's gSDE: those of SAC with our gSDE arguments for Pendulum-v1). `sac` is our GSDESAC
without gSDE, `bro_fast` BRO with two updates per step. The critics of `crossq_jax_512` have the
default width of the constructor, a quarter of the paper's, those of `crossq_jax_narrow` an eighth
of it, those of `simba_narrow` (with four times the learning rate) and `bro_fast_narrow` a quarter;
those of `tqc_jax_narrow` have two layers of 256 instead of three of 512, which two cores can
compute. HDS, which knows a simulation of Pendulum-v1, is run with the few steps of its own file.

Each run is a fresh process; training stops for each evaluation, whose time does not count.
`seconds` of the runs depend on the day; the tables use the times of `model_free_pace.py`. On
Pendulum-v1, policies start from the 500 states whose best return is known (SB3_HDS_DATA);
elsewhere, from ten resets with the same seeds. Learners that only stop at the end of an episode may
have made more steps than the mark at which they are compared. Finished runs are kept, so an
interrupted benchmark resumes. Long runs, on all tasks but Pendulum-v1, save model and replay buffer
at every mark, from which an interrupted run resumes with a new episode and other random numbers.
"""

import argparse
import importlib
import time
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from episodes import returns_of
from pendulum import held_out_states, rollouts
from runs import CACHE, InterruptedRun, arguments_of, fresh_process, resume

PENDULUM = "Pendulum-v1"
CAR, CART_POLE = "MountainCarContinuous-v0", "InvertedPendulum-v5"
#: steps of a run, and between two evaluations
LENGTHS = {
    PENDULUM: (10_000, 1_000),
    CAR: (20_000, 2_000),
    CART_POLE: (20_000, 2_000),
    "Hopper-v5": (50_000, 5_000),
    "HalfCheetah-v5": (100_000, 10_000),
}


class Ours(NamedTuple):
    """
    :param file: id in the zoo, whose hyperparameters are used
    :param changes: changed hyperparameters
    :param peers: the same method in other libraries; if there is none, the one that it improves on
    """

    file: str
    changes: dict[str, Any]
    peers: tuple[str, ...]


class Peer(NamedTuple):
    """
    :param file: of RL Zoo, whose hyperparameters are used
    :param changes: changed hyperparameters
    """

    library: str
    name: str
    file: str
    changes: dict[str, Any]


def _widths(actor: list[int], critics: list[int]) -> dict[str, Any]:
    return {"policy_kwargs": {"net_arch": {"pi": actor, "qf": critics}}}


_SAC = ("sb3_sac", "sbx_sac")
OURS = {
    "sac": Ours("gsde_sac", {"use_sde": False, "train_freq": 1, "gradient_steps": 1}, _SAC),
    "gsde_sac": Ours("gsde_sac", {}, ("sb3_gsde_sac", *_SAC)),
    "droq": Ours("droq", {}, ("sbx_droq",)),
    "crossq_jax": Ours("crossq_jax", {}, ("contrib_crossq", "sbx_crossq")),
    "tqc_jax": Ours("tqc_jax", {}, ("contrib_tqc", "sbx_tqc")),
    "simba": Ours("simba", {}, _SAC),
    "td7": Ours("td7", {}, _SAC),
    "bro": Ours("bro", {}, _SAC),
    "bro_fast": Ours("bro", {"gradient_steps": 2}, _SAC),
    "hds": Ours("hds", {}, _SAC),
    "crossq_jax_narrow": Ours("crossq_jax", _widths([256, 256], [256, 256]), _SAC),
    "simba_narrow": Ours("simba", _widths([128], [128, 128]) | {"learning_rate": 4e-4}, _SAC),
    "tqc_jax_narrow": Ours("tqc_jax", _widths([256, 256], [256, 256]), ("contrib_tqc", "sbx_tqc")),
    "bro_fast_narrow": Ours("bro", {"gradient_steps": 2} | _widths([256], [128, 128]), _SAC),
    "crossq_jax_512": Ours("crossq_jax", _widths([256, 256], [512, 512]), _SAC),
}
_DROQ = {
    "policy_kwargs": {"dropout_rate": 0.01, "layer_norm": True},
    "gradient_steps": 20,
    "policy_delay": 20,
}
_GSDE = {
    "use_sde": True,
    "train_freq": 8,
    "gradient_steps": 8,
    "policy_kwargs": {"log_std_init": -1},
}
PEERS = {
    "sb3_sac": Peer("stable_baselines3", "SAC", "sac", {}),
    "sb3_gsde_sac": Peer("stable_baselines3", "SAC", "sac", _GSDE),
    "contrib_tqc": Peer("sb3_contrib", "TQC", "tqc", {}),
    "contrib_crossq": Peer("sb3_contrib", "CrossQ", "crossq", {}),
    "sbx_sac": Peer("sbx", "SAC", "sac", {}),
    "sbx_tqc": Peer("sbx", "TQC", "tqc", {}),
    "sbx_crossq": Peer("sbx", "CrossQ", "crossq", {}),
    "sbx_droq": Peer("sbx", "SAC", "sac", _DROQ),
}
#: RL Zoo has nothing for InvertedPendulum, and for SAC on MountainCarContinuous what it has is gSDE
_IN_THE_ZOO = tuple(env for env in LENGTHS if env != CART_POLE)
_WITHOUT_SDE = tuple(env for env in _IN_THE_ZOO if env != CAR)
#: where the files have the widths of the papers
_WIDE = ("Hopper-v5", "HalfCheetah-v5")
#: HDS plans in the twin of the environment, and has settings for those that have one
ONLY_ON = (
    {"hds": (PENDULUM,)}
    | dict.fromkeys([method for method in OURS if method.endswith("_narrow")], _WIDE)
    | {"crossq_jax_512": (PENDULUM, *_WIDE)}
    | dict.fromkeys(PEERS, _IN_THE_ZOO)
    | dict.fromkeys(("sb3_gsde_sac", "sbx_droq"), _WITHOUT_SDE)
)
N_EPISODES = 10
KEYS = ("env", "method", "seed")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--env", default=PENDULUM, choices=list(LENGTHS))
    parser.add_argument("--methods", nargs="*", choices=[*OURS, *PEERS], default=[*OURS, *PEERS])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--figure", action="store_true")
    arguments = arguments_of(parser, worker)
    if not arguments.figure:
        wanted = [
            (arguments.env, method, seed)
            for seed in range(arguments.seeds)
            for method in arguments.methods
            if arguments.env in ONLY_ON.get(method, LENGTHS)
        ]
        in_process = partial(fresh_process, __file__, cache=CACHE)
        resume("model_free", KEYS, wanted, in_process, arguments.jobs, through)
    from model_free_report import report

    report()


def through(run: tuple[Any, ...], rows: list[dict[str, Any]]) -> bool:
    """:return: whether a run reached its last mark, or was deliberately stopped before"""
    env, method, _ = run
    return max(row["mark"] for row in rows) >= marks(env, method)[-1]


def worker(env: str, method: str, seed: int) -> list[dict]:
    """Train; stop the clock and evaluate at every mark."""
    run = InterruptedRun(CACHE / "model_free" / f"{env}_{method}_{seed}")
    rows, evaluate = run.rows(), evaluation(env)
    model = run.model(class_of(env, method), env) if rows else learner(env, method, seed)
    seconds = rows[-1]["seconds"] if rows else 0.0
    for mark in marks(env, method)[len(rows) :]:
        begin = time.perf_counter()
        if model.num_timesteps < mark:
            model.learn(mark - model.num_timesteps, reset_num_timesteps=False)
        seconds += time.perf_counter() - begin
        returns = evaluate(model)
        stderr = returns.std() / np.sqrt(len(returns))
        now = {"mark": mark, "steps": model.num_timesteps, "seconds": seconds}
        rows.append(now | {"return": float(returns.mean()), "stderr": float(stderr)})
        if env != PENDULUM:
            run.keep(model, rows)
    run.forget()
    return rows


def marks(env: str, method: str) -> range:
    """:return: steps after which a method is evaluated"""
    total, every = LENGTHS[env]
    if method == "hds":
        total = int(entry(_own_file("hds"), env)["n_timesteps"])
    return range(every, total + 1, every)


def learner(env: str, method: str, seed: int) -> Any:
    """:return: an untrained model"""
    return class_of(env, method)("MlpPolicy", env, seed=seed, **made_of(env, method)[1])


def class_of(env: str, method: str) -> type:
    """:return: that of the method; its schedules are those of the whole run, not of each part"""
    total = marks(env, method)[-1]

    class InParts(made_of(env, method)[0]):
        def _update_current_progress_remaining(self, num_timesteps: int, _: int) -> None:
            super()._update_current_progress_remaining(num_timesteps, total)

    return InParts


def made_of(env: str, method: str) -> tuple[type, dict[str, Any]]:
    """:return: class and hyperparameters of a method"""
    if method in OURS:
        from sb3_hds import algos

        ours = OURS[method]
        settings = entry(_own_file(ours.file), env)
        both = [given.get("policy_kwargs", {}) for given in (settings, ours.changes)]
        settings |= ours.changes
        if any(both):
            settings["policy_kwargs"] = both[0] | both[1]
        algorithm = algos.ALL[ours.file]
    else:
        peer = PEERS[method]
        settings = entry(_zoo_file(peer.file), env) | peer.changes
        algorithm = getattr(importlib.import_module(peer.library), peer.name)
    kind, deviation = (settings.pop(name, None) for name in ("noise_type", "noise_std"))
    if kind is not None:
        settings["action_noise"] = noise_of(kind, deviation)
    return algorithm, {k: v for k, v in settings.items() if k not in ("n_timesteps", "policy")}


def noise_of(kind: str, deviation: float) -> Any:
    """
    :param kind: as RL Zoo calls it
    :return: of a single control
    """
    from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise

    if kind != "ornstein-uhlenbeck":
        raise ValueError(f"No file here has noise_type '{kind}'.")
    return OrnsteinUhlenbeckActionNoise(np.zeros(1), np.full(1, deviation))


@cache
def _entries(path: Path) -> dict[str, dict[str, Any]]:
    return yaml.safe_load(path.read_text())


def entry(path: Path, env: str) -> dict[str, Any]:
    """
    :param path: of a file of hyperparameters in the format of RL Zoo
    :return: the entry of an environment, or of the version before
    """
    entries = _entries(path)
    found = dict(entries[env if env in entries else env.replace("-v5", "-v4")])
    if isinstance(found.get("policy_kwargs"), str):
        names = {"__builtins__": {}, "dict": dict}
        found["policy_kwargs"] = eval(found["policy_kwargs"], names)
    return found


def _own_file(name: str) -> Path:
    return Path(__file__).parent.parent / "hyperparams" / f"{name}.yml"


def _zoo_file(name: str) -> Path:
    import rl_zoo3

    return Path(rl_zoo3.__file__).parent / "hyperparams" / f"{name}.yml"


def evaluation(env: str):
    """:return: function from a model to its returns, from the same start states for all"""
    if env == PENDULUM:
        angles, speeds, _ = held_out_states()
        return lambda model: rollouts(model, angles, speeds)
    import gymnasium

    return lambda model: returns_of(model, [gymnasium.make(env) for _ in range(N_EPISODES)], 70_000)


if __name__ == "__main__":
    main()
