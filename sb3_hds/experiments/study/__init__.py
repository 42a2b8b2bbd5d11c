"""
Studies: algorithms, environments and seeds, run, resumed and reported.

Names are imported on first use.
"""

from typing import TYPE_CHECKING

from sb3_hds.lazy import lazily

if TYPE_CHECKING:
    from sb3_hds.experiments.study.definition import Run, Study, zoo_command
    from sb3_hds.experiments.study.report import Reported, results_of, write_report
    from sb3_hds.experiments.study.runner import (
        Done,
        Progress,
        is_complete,
        progress_of,
        run_study,
        seconds_to_go,
    )

__all__ = [
    "Done",
    "Progress",
    "Reported",
    "Run",
    "Study",
    "is_complete",
    "progress_of",
    "results_of",
    "run_study",
    "seconds_to_go",
    "write_report",
    "zoo_command",
]

lazily(
    __name__,
    {
        "Done": "sb3_hds.experiments.study.runner",
        "Progress": "sb3_hds.experiments.study.runner",
        "Reported": "sb3_hds.experiments.study.report",
        "Run": "sb3_hds.experiments.study.definition",
        "Study": "sb3_hds.experiments.study.definition",
        "is_complete": "sb3_hds.experiments.study.runner",
        "progress_of": "sb3_hds.experiments.study.runner",
        "results_of": "sb3_hds.experiments.study.report",
        "run_study": "sb3_hds.experiments.study.runner",
        "seconds_to_go": "sb3_hds.experiments.study.runner",
        "write_report": "sb3_hds.experiments.study.report",
        "zoo_command": "sb3_hds.experiments.study.definition",
    },
)
