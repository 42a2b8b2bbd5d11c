"""``sb3-hds export`` and ``sb3-hds run``; neither loads jax or torch before it needs them."""

import argparse
import contextlib
import tempfile
import time
from pathlib import Path

from sb3_hds.cli import policies
from sb3_hds.errors import ParameterError


def add_export(command: argparse.ArgumentParser) -> None:
    """:param command: ``sb3-hds export``"""
    command.add_argument(
        "model", metavar="MODEL", help="zip file of a saved model, or an .onnx file, for --c"
    )
    command.add_argument("onnx", nargs="?", metavar="FILE.onnx", help="ONNX file to write")
    command.add_argument("--c", metavar="FILE.h", help="header of C99 to write")
    command.add_argument(
        "--algo",
        help="id in the zoo, or a class, sbx.SAC: who saved the model, where that was another "
        "library; its file is then unpickled",
    )
    policies.add_env(
        command, "as trained in: tells names, units, the length of a step", required=False
    )
    command.add_argument(
        "--vecnormalize", metavar="FILE.pkl", help="of the training; it is unpickled"
    )
    command.add_argument(
        "--no-layers", action="store_true", help="leave all wrappers to where the file runs"
    )
    command.add_argument("--dt", type=float, help="how long a step is [s]")
    command.set_defaults(run=run_export)


def run_export(given: argparse.Namespace) -> None:
    """Export, and tell what was written."""
    from sb3_hds.core.trajectories.storage import check_target
    from sb3_hds.deploy import export_c, export_onnx

    exported = Path(given.model).suffix == ".onnx"
    if exported and given.onnx:
        raise ParameterError(
            f"{given.model} is exported already. Name a saved model, or only --c {given.onnx}."
        )
    if not (given.onnx or given.c):
        raise ParameterError("Name a file to write: policy.onnx, or --c policy.h.")
    if given.onnx and Path(given.onnx).suffix != ".onnx":
        raise ParameterError(f"The file to write must end in .onnx, got '{given.onnx}'.")
    for target in filter(None, (given.onnx, given.c)):
        check_target(target)
    with contextlib.ExitStack() as stack:
        env = None
        if given.env is not None:
            env = policies.wrapped(given, policies.bare_environment(given))
            stack.callback(env.close)
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        source = given.model
        if not exported:
            source = given.onnx or str(Path(folder, f"{Path(given.model).stem}.onnx"))
            done = export_onnx(
                policies.load_policy(given.model, given.algo),
                source,
                env=env,
                layers=not given.no_layers,
                normalize=given.vecnormalize,
                dt=given.dt,
            )
            if given.onnx:
                print(done)
        if given.c:
            print(export_c(source, given.c))


def add_run(command: argparse.ArgumentParser) -> None:
    """:param command: ``sb3-hds run``"""
    command.add_argument("policy", metavar="FILE.onnx", help="of 'sb3-hds export'")
    policies.add_env(command, "environment id: a simulation, or a robot")
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
    command.set_defaults(run=run_policy_file)


def run_policy_file(given: argparse.Namespace) -> None:
    """Act at the policy's rate, and tell what it took."""
    from sb3_hds.deploy import OnnxPolicy, run_policy

    policy = OnnxPolicy(given.policy)
    record = given.record
    if record is None:
        file = Path(given.policy)
        record = file.with_name(f"{file.stem}-{time.strftime('%Y%m%d-%H%M%S')}.jsonl")
    elif record == "-":
        record = None
    env = policies.wrapped(given, policies.bare_environment(given))
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
