"""
Studies: run algorithms on environments with several seeds, resume, and report.

Names are imported on first use.
"""

from sb3_hds.lazy import lazy_imports

with lazy_imports(__name__):
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
