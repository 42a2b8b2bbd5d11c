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
        help="parameters to estimate, or patterns in quotes, '*_damping'; default: all of the twin",
    )
    command.add_argument(
        "--effects",
        nargs="*",
        default=[],
        metavar="NAME[.PLACE]",
        help="of 'sb3-hds effects' that the twin is extended by first, at every place or at one: "
        "action_delay, coulomb_friction.hinge",
    )
    command.add_argument(
        "--tied",
        nargs="*",
        default=[],
        metavar="PATTERN",
        help="parameters that take one value, as of joints of a kind: '*_hip_joint_damping' "
        "'action_delay.*.delay'",
    )
    command.add_argument(
        "--errors",
        choices=("simulation", "force"),
        default="simulation",
        help="that are made small: of simulated windows (the default), or of the equation of "
        "motion, for logs of torques that the twin explains worse than its sensors measure",
    )
    command.add_argument(
        "--windows", type=int, help="how many windows to use, drawn at random; default: all"
    )
    command.add_argument("--window", type=int, help="steps of a window; default: half a second")
    command.add_argument(
        "--prior",
        type=float,
        default=0.0,
        help="weight of the prior at the twin's own values, with a standard deviation of "
        "1 / PRIOR typical deviations; default: 0, no prior",
    )
    command.add_argument(
        "--level", type=float, default=0.95, help="of the confidence intervals; default: 0.95"
    )
    command.add_argument("--json", help="JSON file to write")
    measured.add_write(command)
    command.set_defaults(run=run)


def run(given: argparse.Namespace) -> None:
    """Audit, estimate, and report: on the screen, as JSON, as a twin."""
    from sb3_hds.data import audit
    from sb3_hds.errors import TrajectoryError
    from sb3_hds.sysid import calibrate
    from sb3_hds.sysid.estimation.calibrate import check_fits
    from sb3_hds.sysid.estimation.parameters import free_names

    measured.check_targets(given)
    twin, data = measured.question(given)
    twin = _extended(twin, names(given.effects))
    tied = {pattern: _spelt_out([pattern], twin) for pattern in names(given.tied)}
    free = free_names(twin, _spelt_out(names(given.free), twin) or None)
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
    """The twin with the named effects, at the named places or at all."""
    from sb3_hds.effects import ALL, effect_named

    places = {"joint": twin.joints, "actuator": twin.actuators, "channel": twin.channels}
    found = []
    for word in wanted:
        name, _, place = word.partition(".")
        kind = effect_named(name, ALL)
        at = [place] if place else [each.name for each in places[kind.slot]]
        found += [kind(where) for where in at]
    return twin.extend(*found) if found else twin


def _spelt_out(patterns: Sequence[str], twin: "Twin") -> list[str]:
    """Expand patterns into names; a pattern without a match is kept, and refused later."""
    found: dict[str, None] = {}
    for pattern in patterns:
        hits = [name for name in twin.parameters if fnmatchcase(name, pattern)]
        found |= dict.fromkeys(hits or [pattern])
    return list(found)
