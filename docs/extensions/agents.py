"""The table of ``trained_agents``."""

import json
from pathlib import Path

import numpy as np
from tables import table

AGENTS = Path(__file__).parent.parent.parent / "trained_agents"


def as_markdown(folder: Path = AGENTS) -> str:
    """
    :param folder: of a study
    :return: Markdown with a row for each of its agents
    """
    found = [_row(mark) for mark in folder.glob("*/*/study.json")]
    rows = [[f"`{name}`", env, *others] for env, name, *others in sorted(found)]
    return table(["algorithm", "environment", "steps", "return", "minutes"], rows)


def _row(mark: Path) -> list[str]:
    run = json.loads(mark.read_text())["settings"]
    with np.load(mark.with_name("evaluations.npz")) as held:
        value, steps = held["results"][-1].mean(), int(held["timesteps"][-1])
    seconds = float(mark.with_name("clock.csv").read_text().split()[-1].partition(",")[2])
    return [run["env"], run["algo"], f"{steps:,}", f"{value:.1f}", f"{seconds / 60.0:.1f}"]
