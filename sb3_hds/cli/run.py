"""``sb3-hds run``: without jax and torch, where the environment has none."""

import argparse
import time
from pathlib import Path
from typing import Any

from sb3_hds.cli.settings import yml_setting


def add_arguments(command: argparse.ArgumentParser) -> None:
    """:param command: that is to understand them"""
    command.add_argument("policy", metavar="FILE.onnx", help="of 'sb3-hds export'")
    command.add_argument("--env", required=True, help="environment id: a simulation, or a robot")
    command.add_argument("--env-kwargs", nargs="*", default=[], metavar="NAME:VALUE")
    command.add_argument(
        "--env-wrapper",
        nargs="*",
        default=[],
        metavar="CLASS",
        help="the one next to the environment first, as in 'sb3-hds robustness'",
    )
    command.add_argument("--rate", type=float, help="steps per second [Hz]; default: as trained")
    command.add_argument("--episodes", type=int, default=1, help="default: 1")
    command.add_argument("--steps", type=int, help="after which it ends in any case")
    command.add_argument("--seed", type=int, help="of the first reset")
    command.add_argument(
        "--safe-action",
        type=float,
        nargs="+",
        metavar="NUMBER",
        help="what a watchdog commands where the policy is late; default: there is no watchdog",
    )
    command.add_argument(
        "--record",
        metavar="FILE.jsonl",
        help="recording to write, for 'sb3-hds diagnose'; default: POLICY-DATE.jsonl beside the "
        "policy; '-': none",
    )
    command.add_argument("--condition", default="default", help="label of what is recorded")


def run(given: argparse.Namespace) -> None:
    """Act at the policy's rate, and tell what it took."""
    from sb3_hds.deploy import OnnxPolicy, run_policy

    policy = OnnxPolicy(given.policy)
    record = given.record
    if record is None:
        file = Path(given.policy)
        record = file.with_name(f"{file.stem}-{time.strftime('%Y%m%d-%H%M%S')}.jsonl")
    elif record == "-":
        record = None
    env = _environment(given)
    latencies = run_policy(
        policy,
        env,
        rate=given.rate,
        n_episodes=given.episodes,
        max_steps=given.steps,
        record=record,
        condition=given.condition,
        seed=given.seed,
        safe_action=given.safe_action,
    )
    print(latencies)
    if record is not None:
        print(f"recording: {record}")


def _environment(given: argparse.Namespace) -> Any:
    from sb3_hds.cli.classes import wrapped, wrapper
    from sb3_hds.cli.robustness import _made

    wrappers = [wrapper(text) for text in given.env_wrapper]
    return wrapped(wrappers, _made(given.env, dict(map(yml_setting, given.env_kwargs))))
