"""``sb3-hds calibrate``."""

import argparse
import textwrap

from sb3_hds.cli import measured
from sb3_hds.cli.settings import names


def add_arguments(command: argparse.ArgumentParser) -> None:
    """:param command: that is to understand them"""
    measured.add_arguments(command)
    command.add_argument(
        "--free", nargs="*", default=[], help="parameters to estimate; default: all of the twin"
    )
    command.add_argument(
        "--prior",
        type=float,
        default=0.0,
        help="how firmly to believe the twin's own values: they are taken to be right to within "
        "1 / PRIOR of a usual deviation; default: 0, not at all",
    )
    command.add_argument(
        "--level", type=float, default=0.95, help="of the confidence intervals; default: 0.95"
    )
    command.add_argument("--json", help="JSON file to write")
    command.add_argument("--write", help="JSON file to write the calibrated twin to, for --twin")


def run(given: argparse.Namespace) -> None:
    """Audit, estimate, and tell: on the screen, as JSON, as a twin."""
    from sb3_hds.core.storage import check_target
    from sb3_hds.data import audit
    from sb3_hds.errors import TrajectoryError
    from sb3_hds.sysid import calibrate
    from sb3_hds.sysid.calibrate import check_fits, free_names

    for target in filter(None, (given.json, given.write)):
        check_target(target)
    twin = measured.twin_of(given)
    free = free_names(twin, names(given.free) or None)
    data = measured.data_of(given)
    check_fits(twin, data)
    found, caveats = audit(data, twin=twin), []
    if given.correct and found.corrections:
        caveats += found.corrections
        data = found.corrected(data)
        found = audit(data, twin=twin)
    if not found.usable:
        raise TrajectoryError(f"No parameter can be estimated from these data. {found.reason}")
    caveats += [str(finding) for finding in found.findings]
    fit = calibrate(twin, data, free=free, prior=given.prior, level=given.level)
    print(fit)
    for caveat in caveats:
        print("\n".join(textwrap.wrap(f"Caveat: {caveat}", 80, subsequent_indent="  ")))
    spec = {"twin": fit.twin.to_spec()}
    if given.json:
        measured.write_json(given.json, fit.to_dict() | spec | {"data_caveats": caveats})
    if given.write:
        measured.write_json(given.write, spec)
