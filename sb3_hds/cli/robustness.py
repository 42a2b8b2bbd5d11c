"""``sb3-hds robustness``."""

import argparse
import csv
import functools
import io
import sys
from typing import Any

from sb3_hds.cli.classes import algorithm, wrapped, wrapper
from sb3_hds.cli.settings import yml_setting


def run(given: argparse.Namespace) -> None:
    """Shake a policy and tell what it earned: on the screen, as a table."""
    from sb3_hds.core.storage import write_bytes
    from sb3_hds.experiments import PERTURBATIONS, measure_robustness

    changed = {name: dict(settings) for name, settings in PERTURBATIONS.items()}
    changed["push"]["push"] = given.push
    kwargs = dict(map(yml_setting, given.env_kwargs))
    wrap = functools.partial(wrapped, [wrapper(text) for text in given.env_wrapper])
    found = measure_robustness(
        algorithm(given.algo).load(given.model),
        functools.partial(_made, given.env, kwargs),
        wrapper=wrap,
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


def _made(env_id: str, kwargs: dict[str, Any]) -> Any:
    import gymnasium

    from sb3_hds.errors import EnvironmentMismatchError

    try:
        return gymnasium.make(env_id, **kwargs)
    except (gymnasium.error.Error, TypeError) as error:
        raise EnvironmentMismatchError(f"There is no '{env_id}' with {kwargs}: {error}") from error
