"""
``sb3-hds robustness``, ``export`` and ``run``: policies on their way to a machine.

None loads jax or torch before it needs them.
"""

import argparse
import contextlib
import csv
import functools
import io
import sys
import tempfile
import time
from pathlib import Path

from sb3_hds.cli import policies
from sb3_hds.errors import ParameterError


def add_robustness(command: argparse.ArgumentParser) -> None:
    """:param command: ``sb3-hds robustness``"""
    command.add_argument(
        "--algo", required=True, help="id in the zoo, ours or rl_zoo3's, or a class such as sbx.SAC"
    )
    command.add_argument("--model", required=True, help="file of the saved model")
    policies.add_env(command, "environment id")
    command.add_argument(
        "--episodes", type=int, default=20, help="episodes per perturbation; default: 20"
    )
    command.add_argument("--encoders", choices=("own", "observation"), default="own")
    command.add_argument("--vecnormalize", help="vecnormalize.pkl from the training")
    command.add_argument("--push", type=float, default=5.0, help="force on the torso [N]")
    command.add_argument("--csv", help="CSV file to write")
    command.set_defaults(run=run_robustness)


def run_robustness(given: argparse.Namespace) -> None:
    """Measure the return of a policy under disturbances; print it and write a table."""
    from sb3_hds.core.trajectories.storage import write_bytes
    from sb3_hds.experiments import PERTURBATIONS, measure_robustness

    changed = {name: dict(settings) for name, settings in PERTURBATIONS.items()}
    changed["push"]["push"] = given.push
    found = measure_robustness(
        policies.load_policy(given.model, given.algo),
        functools.partial(policies.bare_environment, given),
        wrapper=functools.partial(policies.wrapped, given),
        perturbations=changed,
        n_episodes=given.episodes,
        encoders=given.encoders,
        normalize=given.vecnormalize,
        progress=sys.stderr.isatty(),
    )
    print(found)
    if given.csv:
        lines, rows = io.StringIO(), found.to_rows()
        table = csv.DictWriter(lines, list(rows[0]), lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
        write_bytes(given.csv, lines.getvalue().encode())


def add_export(command: argparse.ArgumentParser) -> None:
    """:param command: ``sb3-hds export``"""
    command.add_argument(
        "model", metavar="MODEL", help="zip file of a saved model; with --c, also an .onnx file"
    )
    command.add_argument("onnx", nargs="?", metavar="FILE.onnx", help="ONNX file to write")
    command.add_argument("--c", metavar="FILE.h", help="C99 header to write")
    command.add_argument(
        "--algo",
        help="algorithm of a model that another library saved: an id in the zoo, or a class, "
        "sbx.SAC; the file is then unpickled",
    )
    policies.add_env(
        command,
        "environment of the training, for names, units and the control interval",
        required=False,
    )
    command.add_argument(
        "--vecnormalize", metavar="FILE.pkl", help="file saved in the training; it is unpickled"
    )
    command.add_argument(
        "--no-layers",
        action="store_true",
        help="export the bare policy: keep wrappers of sb3_hds.wrappers out of the file",
    )
    command.add_argument("--dt", type=float, help="control interval [s]")
    command.set_defaults(run=run_export)


def run_export(given: argparse.Namespace) -> None:
    """Export, and print what was written."""
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
    command.add_argument("policy", metavar="FILE.onnx", help="file from 'sb3-hds export'")
    policies.add_env(command, "environment id, of a simulation or a robot")
    command.add_argument("--rate", type=float, help="steps per second [Hz]; default: as trained")
    command.add_argument("--episodes", type=int, default=1, help="number of episodes; default: 1")
    command.add_argument("--steps", type=int, help="maximum number of steps in total")
    command.add_argument("--seed", type=int, help="seed of the first reset")
    command.add_argument(
        "--safe-action",
        type=float,
        nargs="+",
        metavar="NUMBER",
        help="command of the watchdog when the policy is late; default: no watchdog",
    )
    command.add_argument(
        "--record",
        metavar="FILE.jsonl",
        help="recording to write, for 'sb3-hds diagnose'; default: POLICY-DATE.jsonl beside the "
        "policy; '-': none",
    )
    command.add_argument("--condition", default="default", help="label of the recording")
    command.set_defaults(run=run_policy_file)


def run_policy_file(given: argparse.Namespace) -> None:
    """Act at the policy's rate, and print the latencies."""
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
