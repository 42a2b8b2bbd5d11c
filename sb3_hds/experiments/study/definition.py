"""Definition of a study: algorithms, environments and seeds, each run by a command of RL Zoo."""

import dataclasses
import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import yaml

from sb3_hds.errors import StudyError, did_you_mean

_KEYS = ("name", "algorithms", "envs", "seeds", "budget", "evaluation")
_ALGORITHM = ("label", "algo", "hyperparams", "envs")
_ENV = ("id", "kwargs")
# Instead of a number of steps: n_timesteps of the hyperparameter file.
_OF_FILE = "file"


class Run(NamedTuple):
    """
    :param label: of the algorithm with its hyperparameters, in lower case: a folder of the zoo
    :param algo: id in the zoo
    :param hyperparams: replace those of its file
    """

    label: str
    algo: str
    hyperparams: Mapping[str, Any]
    env: str
    env_kwargs: Mapping[str, Any]
    seed: int

    @property
    def place(self) -> Path:
        """The zoo's folder of the run, below its log folder."""
        return Path(self.label) / f"{self.env_name}_{self.seed + 1}"

    @property
    def env_name(self) -> str:
        """Name of the environment in file names."""
        return self.env.replace("/", "-")

    def __str__(self) -> str:
        return f"{self.label} on {self.env}, seed {self.seed}"


#: command of a run, given the run, its log folder, its clock file and the folder of its checkpoint
Command = Callable[[Run, Path, Path, Path], Sequence[str]]


@dataclasses.dataclass(frozen=True)
class Study:
    """
    :param name: of the study
    :param runs: of all algorithms, environments and seeds
    :param steps: limit per run; ``"file"``: ``n_timesteps`` of the algorithm's hyperparameter file;
        None: no limit
    :param minutes: limit per run; None: no limit
    :param every: steps between evaluations
    :param episodes: per evaluation
    """

    name: str
    runs: tuple[Run, ...]
    steps: int | Literal["file"] | None
    minutes: float | None
    every: int
    episodes: int

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Study":
        """
        :param path: of a yml file
        :raises StudyError: for unknown, missing or invalid entries
        """
        file = Path(path)
        try:
            content = yaml.safe_load(file.read_text())
        except yaml.YAMLError as error:
            raise StudyError(f"'{path}' is not valid yml: {error}.") from error
        except FileNotFoundError as error:
            raise StudyError(f"There is no study '{path}' (in {Path.cwd()}).") from error
        _check_keys(f"'{path}'", content, _KEYS, ("algorithms", "envs", "budget"))
        budget, evaluation = content["budget"], content.get("evaluation") or {}
        _check_keys("budget", budget, ("steps", "minutes"), ())
        _check_keys("evaluation", evaluation, ("every", "episodes"), ())
        steps, minutes = budget.get("steps"), budget.get("minutes")
        if steps is None and minutes is None:
            raise StudyError("budget needs steps, minutes, or both: {steps: 10000}.")
        default = max(1, steps // 20) if isinstance(steps, int) else 1_000
        numbers = {"steps": steps, "minutes": minutes, "every": evaluation.get("every", default)}
        numbers["episodes"] = evaluation.get("episodes", 10)
        for key, value in numbers.items():
            kinds = int | float if key == "minutes" else int
            if value is None or (key == "steps" and value == _OF_FILE):
                continue
            if not (isinstance(value, kinds) and value > 0):
                or_file = f", or {_OF_FILE}" if key == "steps" else ""
                raise StudyError(f"{key} must be a number above 0{or_file}, got {value!r}.")
        return cls(name=str(content.get("name", file.stem)), runs=_runs(content), **numbers)

    def settings(self, run: Run) -> dict[str, Any]:
        """:return: the settings of a run, as stored in its folder"""
        found = run._asdict() | {"steps": self.steps, "minutes": self.minutes}
        found |= {"every": self.every, "episodes": self.episodes}
        return json.loads(json.dumps(found))


def zoo_command(study: Study, every: float = 5.0) -> Command:
    """
    :param every: minutes between checkpoints; 0: no checkpoints
    :return: makes the command of a run, the zoo's ``train``
    :raises StudyError: if the interval is negative
    """
    if not every >= 0.0:
        raise StudyError(f"Minutes between checkpoints must be 0 or more, got {every:g}.")

    def command(run: Run, logs: Path, clock: Path, checkpoint: Path) -> list[str]:
        found = [sys.executable, "-m", "rl_zoo_plugin.study_worker", str(clock)]
        found += [repr(float(study.minutes or 0.0)), str(checkpoint), repr(float(every))]
        found += ["--algo", run.algo, "--env", run.env]
        found += ["--seed", str(run.seed), "-f", str(logs), "--verbose", "0"]
        if study.steps != _OF_FILE:  # which the zoo reads otherwise
            found += ["-n", str(study.steps or 2**31 - 1)]
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


def _runs(content: Mapping[str, Any]) -> tuple[Run, ...]:
    seeds = content.get("seeds", 5)
    seeds = range(seeds) if isinstance(seeds, int) else seeds
    runs = []
    for given in content["algorithms"]:
        entry: dict[str, Any] = {"algo": given} if isinstance(given, str) else given
        _check_keys("an entry of algorithms", entry, _ALGORITHM, ("algo",))
        label = str(entry.get("label", entry["algo"]))
        if label != label.lower() or "/" in label:
            raise StudyError(f"A label names a folder of the zoo, in lower case, got '{label}'.")
        for given_env in entry.get("envs") or content["envs"]:
            env: dict[str, Any] = {"id": given_env} if isinstance(given_env, str) else given_env
            _check_keys("an entry of envs", env, _ENV, ("id",))
            for seed in seeds:
                hyperparams, kwargs = entry.get("hyperparams") or {}, env.get("kwargs") or {}
                runs.append(Run(label, entry["algo"], hyperparams, env["id"], kwargs, int(seed)))
    places = [run.place for run in runs]
    if len(set(places)) < len(places):
        raise StudyError("Two runs would share a folder: give each algorithm its own label.")
    return tuple(runs)
