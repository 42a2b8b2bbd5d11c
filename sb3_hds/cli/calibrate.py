"""``sb3-hds calibrate``."""

import argparse
import textwrap
from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

from sb3_hds.cli import measured
from sb3_hds.cli.arguments import names

if TYPE_CHECKING:
    from sb3_hds.core import Twin


def add_arguments(command: argparse.ArgumentParser) -> None:
    """:param command: ``sb3-hds calibrate``"""
    measured.add_arguments(command)
    command.add_argument(
        "--free",
        nargs="*",
        default=[],
        help="parameters to estimate, or quoted patterns: '*_damping'; default: all parameters",
    )
    command.add_argument(
        "--effects",
        nargs="*",
        default=[],
        metavar="NAME[.LOCATION]",
        help="effects ('sb3-hds effects') to extend the twin by first, at all locations or at one: "
        "action_delay, coulomb_friction.hinge",
    )
    command.add_argument(
        "--tied",
        nargs="*",
        default=[],
        metavar="PATTERN",
        help="parameters that share one value, such as those of like joints: '*_hip_joint_damping' "
        "'action_delay.*.delay'",
    )
    command.add_argument(
        "--errors",
        choices=("simulation", "force"),
        default="simulation",
        help="errors to minimise: those of simulated windows (default), or of the equation of "
        "motion, for torque logs whose model error exceeds the sensor noise",
    )
    command.add_argument(
        "--windows", type=int, help="number of windows, drawn at random; default: all"
    )
    command.add_argument("--window", type=int, help="steps per window; default: half a second")
    command.add_argument(
        "--prior",
        type=float,
        default=0.0,
        help="weight of the prior at the twin's own values, with a standard deviation of "
        "1 / PRIOR typical deviations; default: 0, no prior",
    )
    command.add_argument(
        "--level", type=float, default=0.95, help="confidence level of the intervals; default: 0.95"
    )
    command.add_argument("--json", help="JSON file to write")
    measured.add_write(command)
    command.set_defaults(run=run)


def run(given: argparse.Namespace) -> None:
    """Audit the data, estimate, and report on the screen, as JSON and as a twin."""
    from sb3_hds.data import audit
    from sb3_hds.errors import TrajectoryError
    from sb3_hds.sysid import calibrate
    from sb3_hds.sysid.estimation.parameters import free_names
    from sb3_hds.sysid.measurements import check_fits

    measured.check_targets(given)
    twin, data = measured.twin_and_data(given)
    twin = _extended(twin, names(given.effects))
    tied = {pattern: _expanded([pattern], twin) for pattern in names(given.tied)}
    free = free_names(twin, _expanded(names(given.free), twin) or None)
    check_fits(twin, data)
    found, caveats = audit(data, twin=twin), []
    if given.correct and found.corrections:
        caveats += found.corrections
        data = found.corrected(data)
        found = audit(data, twin=twin)
    if not found.usable:
        raise TrajectoryError(f"No parameter can be estimated from these data. {found.reason}")
    caveats += [str(finding) for finding in found.findings]
    fit = calibrate(
        twin,
        data,
        free=free,
        tied=tied,
        prior=given.prior,
        level=given.level,
        errors=given.errors,
        window=given.window,
        n_windows=given.windows,
    )
    print(fit)
    for caveat in caveats:
        print("\n".join(textwrap.wrap(f"Caveat: {caveat}", 80, subsequent_indent="  ")))
    spec = {"twin": fit.twin.to_spec()}
    if given.json:
        measured.write_json(given.json, fit.to_dict() | spec | {"data_caveats": caveats})
    measured.write_twin(given, fit.twin)


def _extended(twin: "Twin", wanted: Sequence[str]) -> "Twin":
    """The twin with the named effects, at the named location or at all."""
    from sb3_hds.effects import ALL, effect_named

    locations = {"joint": twin.joints, "actuator": twin.actuators, "channel": twin.channels}
    found = []
    for word in wanted:
        name, _, location = word.partition(".")
        kind = effect_named(name, ALL)
        at = [location] if location else [each.name for each in locations[kind.slot]]
        found += [kind(each) for each in at]
    return twin.extend(*found) if found else twin


def _expanded(patterns: Sequence[str], twin: "Twin") -> list[str]:
    """Expand patterns into names; one without a match stays, and is refused later."""
    found: dict[str, None] = {}
    for pattern in patterns:
        hits = [name for name in twin.parameters if fnmatchcase(name, pattern)]
        found |= dict.fromkeys(hits or [pattern])
    return list(found)
