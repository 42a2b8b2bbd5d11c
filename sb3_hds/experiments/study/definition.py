"""What a study consists of: algorithms, environments and seeds, each run by a command of RL Zoo."""

import dataclasses
import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from sb3_hds.errors import StudyError, did_you_mean

_KEYS = ("name", "algorithms", "envs", "seeds", "budget", "evaluation")
_ALGORITHM = ("label", "algo", "hyperparams")
_ENV = ("id", "kwargs")


class Run(NamedTuple):
    """
    :param label: of the algorithm with its hyperparameters, in lower case: the zoo's folder
    :param algo: id in the zoo
    :param hyperparams: that replace those of its file
    """

    label: str
    algo: str
    hyperparams: Mapping[str, Any]
    env: str
    env_kwargs: Mapping[str, Any]
    seed: int

    @property
    def place(self) -> Path:
        """Where the zoo would put it, below its folder of logs."""
        return Path(self.label) / f"{self.env_name}_{self.seed + 1}"

    @property
    def env_name(self) -> str:
        """Of the environment, in names of files."""
        return self.env.replace("/", "-")

    def __str__(self) -> str:
        return f"{self.label} on {self.env}, seed {self.seed}"


#: what starts a run, given it, its folder of logs, its clock and the folder of its checkpoint
Command = Callable[[Run, Path, Path, Path], Sequence[str]]


@dataclasses.dataclass(frozen=True)
class Study:
    """
    :param name: of the study
    :param runs: all of them
    :param steps: of each, at most; None: as many as its time allows
    :param minutes: of each, at most; None: as long as its steps take
    :param every: steps from one evaluation to the next
    :param episodes: of an evaluation
    """

    name: str
    runs: tuple[Run, ...]
    steps: int | None
    minutes: float | None
    every: int
    episodes: int

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Study":
        """
        :param path: of a yml file
        :raises StudyError: for something in it that is unknown, missing or no number
        """
        file = Path(path)
        try:
            told = yaml.safe_load(file.read_text())
        except yaml.YAMLError as error:
            raise StudyError(f"'{path}' is no yml: {error}.") from error
        except FileNotFoundError as error:
            raise StudyError(f"There is no study '{path}' (in {Path.cwd()}).") from error
        _check_keys(f"'{path}'", told, _KEYS, ("algorithms", "envs", "budget"))
        budget, evaluation = told["budget"], told.get("evaluation") or {}
        _check_keys("budget", budget, ("steps", "minutes"), ())
        _check_keys("evaluation", evaluation, ("every", "episodes"), ())
        steps, minutes = budget.get("steps"), budget.get("minutes")
        if steps is None and minutes is None:
            raise StudyError("budget needs steps, minutes, or both: {steps: 10000}.")
        usual = max(1, steps // 20) if isinstance(steps, int) else 1_000
        numbers = {"steps": steps, "minutes": minutes, "every": evaluation.get("every", usual)}
        numbers["episodes"] = evaluation.get("episodes", 10)
        for key, value in numbers.items():
            whole = key == "minutes" or isinstance(value, int)
            if value is not None and not (isinstance(value, int | float) and value > 0 and whole):
                raise StudyError(f"{key} must be a number above 0, got {value!r}.")
        return cls(name=str(told.get("name", file.stem)), runs=_runs(told), **numbers)

    def settings(self, run: Run) -> dict[str, Any]:
        """:return: what a run is made of, as it is written beside it"""
        told = run._asdict() | {"steps": self.steps, "minutes": self.minutes}
        told |= {"every": self.every, "episodes": self.episodes}
        return json.loads(json.dumps(told))


def zoo_command(study: Study, every: float = 5.0) -> Command:
    """
    :param every: minutes from one checkpoint to the next; 0: none
    :return: what starts a run, by the zoo's ``train``
    :raises StudyError: if checkpoints are less than nothing apart
    """
    if not every >= 0.0:
        raise StudyError(f"Minutes between checkpoints must be 0 or more, got {every:g}.")

    def command(run: Run, logs: Path, clock: Path, checkpoint: Path) -> list[str]:
        steps = study.steps or 2**31 - 1
        found = [sys.executable, "-m", "rl_zoo_plugin.study_worker", str(clock)]
        found += [repr(float(study.minutes or 0.0)), str(checkpoint), repr(float(every))]
        found += ["--algo", run.algo, "--env", run.env]
        found += ["--seed", str(run.seed), "-n", str(steps), "-f", str(logs), "--verbose", "0"]
        found += ["--eval-freq", str(study.every), "--eval-episodes", str(study.episodes)]
        for option, given in (("-params", run.hyperparams), ("--env-kwargs", run.env_kwargs)):
            if given:
                found += [option, *(f"{name}:{value!r}" for name, value in given.items())]
        return found

    return command


def _check_keys(what: str, given: Any, known: Sequence[str], needed: Sequence[str]) -> None:
    if not isinstance(given, Mapping):
        raise StudyError(f"{what} must be a table with {', '.join(known)}, got {given!r}.")
    for key in given:
        if key not in known:
            hint = did_you_mean(str(key), known)
            raise StudyError(f"{what} has '{key}', and takes {', '.join(known)}.{hint}")
    for key in needed:
        if not given.get(key):
            raise StudyError(f"{what} lacks '{key}'.")


def _runs(told: Mapping[str, Any]) -> tuple[Run, ...]:
    seeds = told.get("seeds", 5)
    seeds = range(seeds) if isinstance(seeds, int) else seeds
    runs = []
    for given in told["algorithms"]:
        entry: dict[str, Any] = {"algo": given} if isinstance(given, str) else given
        _check_keys("an entry of algorithms", entry, _ALGORITHM, ("algo",))
        label = str(entry.get("label", entry["algo"]))
        if label != label.lower() or "/" in label:
            raise StudyError(f"A label is a folder of the zoo, in lower case, got '{label}'.")
        for place in told["envs"]:
            env: dict[str, Any] = {"id": place} if isinstance(place, str) else place
            _check_keys("an entry of envs", env, _ENV, ("id",))
            for seed in seeds:
                hyperparams, kwargs = entry.get("hyperparams") or {}, env.get("kwargs") or {}
                runs.append(Run(label, entry["algo"], hyperparams, env["id"], kwargs, int(seed)))
    places = [run.place for run in runs]
    if len(set(places)) < len(places):
        raise StudyError("Two runs would have one folder: give each algorithm a label of its own.")
    return tuple(runs)
