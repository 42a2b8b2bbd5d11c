"""``sb3-hds robustness``."""

import argparse
import csv
import functools
import io
import sys
from pathlib import Path
from typing import Any

from sb3_hds.cli.classes import algorithm, wrapped, wrapper
from sb3_hds.cli.settings import yml_setting


def run(given: argparse.Namespace) -> None:
    """Measure the return of a policy under disturbances: on the screen, as a table."""
    from sb3_hds.core.trajectories.storage import write_bytes
    from sb3_hds.experiments import PERTURBATIONS, measure_robustness

    changed = {name: dict(settings) for name, settings in PERTURBATIONS.items()}
    changed["push"]["push"] = given.push
    kwargs = dict(map(yml_setting, given.env_kwargs))
    wrap = functools.partial(wrapped, [wrapper(text) for text in given.env_wrapper])
    found = measure_robustness(
        _loaded(given.algo, given.model),
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


def _loaded(name: str, path: str) -> Any:
    """
    :raises FileNotFoundError: for a file that there is not, with the nearest that there is
    :raises ParameterError: for a file that holds no model of that algorithm
    """
    from sb3_hds.errors import ParameterError, did_you_mean

    kind, file = algorithm(name), Path(path)
    if not file.is_file() and not file.with_name(f"{file.name}.zip").is_file():
        beside = [str(found) for found in file.parent.glob("*.zip")]
        raise FileNotFoundError(f"There is no model '{path}'.{did_you_mean(path, beside)}")
    try:
        return kind.load(path)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        why = str(error).strip().partition("\n")[0]
        raise ParameterError(f"{path} holds no model of {name}: {why}") from error


def _made(env_id: str, kwargs: dict[str, Any]) -> Any:
    import gymnasium

    from sb3_hds.errors import EnvironmentMismatchError

    try:
        return gymnasium.make(env_id, **kwargs)
    except (gymnasium.error.Error, TypeError) as error:
        raise EnvironmentMismatchError(f"There is no '{env_id}' with {kwargs}: {error}") from error
