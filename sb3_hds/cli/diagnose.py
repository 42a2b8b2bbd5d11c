"""``sb3-hds diagnose``."""

import argparse
import dataclasses
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

from sb3_hds.cli import measured, models
from sb3_hds.cli.arguments import names, settings
from sb3_hds.cli.policies import algorithm
from sb3_hds.errors import ParameterError

if TYPE_CHECKING:
    from sb3_hds.core import Twin
    from sb3_hds.experiments import PolicyGain
    from sb3_hds.sysid import Diagnosis
    from sb3_hds.sysid.design import NextExperiment


# Options that --each excludes.
_OF_ONE = ("report", "animate", "json", "write", "next", "env")


def add_arguments(command: argparse.ArgumentParser) -> None:
    """:param command: ``sb3-hds diagnose``"""
    measured.add_arguments(command)
    command.add_argument(
        "--calibrate",
        nargs="*",
        default=[],
        help="parameters to estimate as well, since their nominal values are uncertain",
    )
    command.add_argument(
        "--effects", nargs="*", help="candidate effects; default: all, see 'sb3-hds effects'"
    )
    command.add_argument("--budget", choices=("full", "quick"), default="full")
    command.add_argument("--seed", type=int, default=0)
    command.add_argument("--report", help="HTML page to write")
    command.add_argument("--animate", help="MP4 film to write: measured and predicted motion")
    command.add_argument("--json", help="JSON file to write")
    measured.add_write(command)
    design = command.add_argument_group(
        "next experiment", "commands that distinguish the remaining hypotheses"
    )
    design.add_argument("--next", metavar="FILE", help="CSV or NPZ file to write the commands to")
    design.add_argument("--limits", metavar="FILE", help="yml file with the limits of the machine")
    design.add_argument(
        "--recordings", type=int, default=1, help="number of recordings to design; default: 1"
    )
    design.add_argument(
        "--seconds", type=float, default=10.0, help="length of a recording [s]; default: 10"
    )
    gain = command.add_argument_group(
        "policy gain", "returns on the real system of policies trained in each twin"
    )
    gain.add_argument("--env", help="id of the real system")
    gain.add_argument(
        "--env-kwargs",
        nargs="*",
        default=[],
        metavar="NAME:VALUE",
        help="arguments of the environment",
    )
    gain.add_argument("--algo", default="hds", help="id of the algorithm in the zoo; default: hds")
    gain.add_argument("--policies", type=int, default=5, help="policies per twin; default: 5")
    gain.add_argument("--policy-budget", type=int, default=0, help="training steps per policy")
    gain.add_argument("--episodes", type=int, default=20, help="episodes per policy; default: 20")
    gain.add_argument(
        "--hyperparams", nargs="*", default=[], metavar="NAME:VALUE", help="hyperparameters"
    )
    each = command.add_argument_group("many logs", "each file diagnosed on its own")
    each.add_argument(
        "--each", metavar="FOLDER", help="for results, pages and a table; resumes where it was"
    )
    each.add_argument("--jobs", type=int, help="parallel diagnoses; default: one per core")
    each.add_argument(
        "--memory", type=float, default=4.0, help="memory per diagnosis [GiB]; default: 4"
    )
    each.add_argument(
        "--ray", metavar="ADDRESS", help="run on the Ray cluster at this address, or auto"
    )
    each.add_argument(
        "--cpus", type=float, default=2.0, help="cores per diagnosis, with --ray; default: 2"
    )
    command.set_defaults(run=run)


def run(given: argparse.Namespace) -> int:
    """
    Load the data, diagnose, and report on the screen, as a page and as JSON.

    :return: with ``--each``, 1 if a diagnosis failed, else 0
    """
    if given.each:
        return _run_each(given)
    for option in ("jobs", "ray"):
        if getattr(given, option) is not None:
            raise ParameterError(f"--{option} is about many logs: name a folder with --each.")
    return _run_one(given)


def _run_each(given: argparse.Namespace) -> int:
    from sb3_hds.data.load import paths_of
    from sb3_hds.experiments.many_logs import diagnose_each
    from sb3_hds.sysid.reporting.page import check_installed

    for option in _OF_ONE:
        if getattr(given, option):
            raise ParameterError(
                f"--{option} is about a single diagnosis; --each writes a JSON file and a page of "
                "each log into its folder."
            )
    check_installed()
    found = diagnose_each(
        paths_of(given.data),
        _arguments_of(given),
        given.each,
        jobs=given.jobs,
        memory=given.memory,
        ray=given.ray,
        cpus=given.cpus,
    )
    failed = sum(bool(one.error) for one in found)
    print(f"{len(found) - failed} of {len(found)} logs are diagnosed in {given.each}.")
    return 1 if failed else 0


def _arguments_of(given: argparse.Namespace) -> list[str]:
    """What all diagnoses of ``--each`` share, as words of the command line."""
    words = ["--correct"] if given.correct else []
    for option in ("twin", "model", "columns", "budget", "seed"):
        value = getattr(given, option)
        words += [] if value is None else [f"--{option}", str(value)]
    for option in ("set", *models.OPTIONS, "calibrate", "effects"):
        values = getattr(given, option)
        words += [f"--{option}", *values] if values else []
    return words


def _run_one(given: argparse.Namespace) -> int:
    from sb3_hds.data import audit
    from sb3_hds.effects import ALL
    from sb3_hds.sysid import diagnose

    _check_targets(given)
    twin, data = measured.twin_and_data(given)
    measure = None if given.env is None else _policy_comparison(given, twin)
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
        print("The twin is unchanged, so there are no policies to compare.")
    elif measure is not None:
        comparison = measure(found)
        print(comparison)
        plain["policy_gain"] = gain = comparison.to_dict()
    if given.json:
        measured.write_json(given.json, plain)
    measured.write_twin(given, found.twin)
    if given.animate and found.pictures is None:
        print("Nothing was simulated, so there is no film.")
    elif given.animate:
        print(f"The film is {found.to_film(given.animate)}.")
    experiment = _next_experiment(given, found)
    if given.report:
        print(f"The report is {found.to_html(given.report, gain, experiment)}.")
    return 0


def _next_experiment(given: argparse.Namespace, found: "Diagnosis") -> "NextExperiment | None":
    """Design the experiment of ``--next``, print it and write its commands."""
    if not given.next:
        return None
    if found.opened is None:
        print("No cause was searched for, so there is no next experiment to design.")
        return None
    experiment = found.next_experiment(
        given.limits,
        n=given.recordings,
        seconds=given.seconds,
        seed=given.seed,
        progress=sys.stderr.isatty(),
    )
    print(experiment)
    print(f"The commands are {experiment.save(given.next)}.")
    return experiment


def _check_targets(given: argparse.Namespace) -> None:
    """Check before the diagnosis everything that could fail after it."""
    measured.check_targets(given)
    if given.animate:
        from sb3_hds.sysid.reporting.film import check_film

        check_film(given.animate)
    if given.next:
        _check_next(given)
    if given.report:
        from sb3_hds.sysid.reporting.page import check_installed, check_page

        check_page(given.report)
        check_installed()


def _check_next(given: argparse.Namespace) -> None:
    from sb3_hds.sysid.design import Limits
    from sb3_hds.sysid.design.result import check_file

    check_file(given.next)
    if not given.limits:
        raise ParameterError(
            "--next designs commands for a real machine: give its limits, --limits limits.yml, "
            "with lines such as 'velocity: 6.0' or 'torque: {shoulder: 2.0}'."
        )
    Limits.of(given.limits)


def _policy_comparison(
    given: argparse.Namespace, twin: "Twin"
) -> "Callable[[Diagnosis], PolicyGain]":
    """Check the arguments of the policy comparison; return the function that runs it."""
    import gymnasium

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
