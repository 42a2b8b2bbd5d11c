"""``sb3-hds robustness``."""

import argparse
import csv
import functools
import io
import sys

from sb3_hds.cli import policies


def add_arguments(command: argparse.ArgumentParser) -> None:
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
    command.set_defaults(run=run)


def run(given: argparse.Namespace) -> None:
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
