"""``sb3-hds diagnose``."""

import argparse
import dataclasses
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

from sb3_hds.cli import measured
from sb3_hds.cli.classes import algorithm
from sb3_hds.cli.settings import names, settings

if TYPE_CHECKING:
    from sb3_hds.core import Twin
    from sb3_hds.experiments import PolicyGain
    from sb3_hds.sysid import Diagnosis


def run(given: argparse.Namespace) -> None:
    """Load, diagnose, and report: on the screen, as a page, as JSON."""
    from sb3_hds.data import audit
    from sb3_hds.effects import ALL
    from sb3_hds.sysid import diagnose

    _check_targets(given)
    twin, data = measured.question(given)
    measure = None if given.env is None else _policy_question(given, twin)
    corrections: tuple[str, ...] = ()
    if given.correct:
        checked = audit(data, twin=twin)
        corrections, data = checked.corrections, checked.corrected(data)
    found = diagnose(
        twin,
        data,
        effects=ALL if given.effects is None else names(given.effects),
        calibrate=names(given.calibrate),
        seed=given.seed,
        budget=given.budget,
        progress=sys.stderr.isatty(),
    )
    found = dataclasses.replace(found, caveats=(*corrections, *found.caveats))
    print(found)
    plain, gain = found.to_dict(), None
    if measure is not None and found.twin.values == found.believed.values:
        print("The twin is left as it was, so there are no policies to compare.")
    elif measure is not None:
        bought = measure(found)
        print(bought)
        plain["policy_gain"] = gain = bought.to_dict()
    if given.json:
        measured.write_json(given.json, plain)
    measured.write_twin(given, found.twin)
    if given.animate and found.pictures is None:
        print("Nothing was simulated, so there is no film.")
    elif given.animate:
        print(f"The film is {found.to_film(given.animate)}.")
    if given.report:
        print(f"The report is {found.to_html(given.report, gain)}.")


def _check_targets(given: argparse.Namespace) -> None:
    """Fail early: check everything that would fail after the diagnosis."""
    from sb3_hds.core.trajectories.storage import check_target

    for target in filter(None, (given.json, given.write)):
        check_target(target)
    measured.check_write(given)
    if given.animate:
        from sb3_hds.sysid.reporting.film import check_film

        check_film(given.animate)
    if given.report:
        from sb3_hds.sysid.reporting.page import check_installed, check_page

        check_page(given.report)
        check_installed()


def _policy_question(
    given: argparse.Namespace, twin: "Twin"
) -> "Callable[[Diagnosis], PolicyGain]":
    """The comparison of policies, to be run on a diagnosis; its arguments are checked now."""
    import gymnasium

    from sb3_hds.errors import ParameterError
    from sb3_hds.experiments import measure_policy_gain
    from sb3_hds.experiments.policy_gain import check_question

    arguments = settings("--hyperparams", given.hyperparams)
    try:
        env = gymnasium.make(given.env, **settings("--env-kwargs", given.env_kwargs))
    except (gymnasium.error.Error, TypeError) as error:
        raise ParameterError(f"{given.env} cannot be made: {error}") from None
    learner, size = algorithm(given.algo), (given.policy_budget, given.policies, given.episodes)
    check_question(twin, env, learner, *size, arguments)
    return lambda found: measure_policy_gain(
        found,
        env,
        learner,
        budget=given.policy_budget,
        seeds=given.policies,
        n_episodes=given.episodes,
        progress=sys.stderr.isatty(),
        **arguments,
    )
