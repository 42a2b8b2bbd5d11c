"""
Storages of ``rl_zoo3 train -optimize --storage``, which several processes share.

A process that dies leaves its trial in the state RUNNING, and ``--max-total-trials`` counts it.
Here, each process records a heartbeat of its trial every minute; before it begins another one, it
fails trials whose heartbeat has stopped, and queues their hyperparameters again. Optuna has this
for databases; :class:`Journal` adds it to journal files.
"""

import contextlib
import os
import time
import warnings
from typing import Any

import optuna
from optuna.exceptions import ExperimentalWarning, UpdateFinishedTrialError
from optuna.storages import JournalStorage, RDBStorage, RetryHeartbeatStaleTrialCallback
from optuna.storages._heartbeat import BaseHeartbeat
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState
from sqlalchemy.exc import IntegrityError, ProgrammingError

# Between two heartbeats [s]; a trial without one for twice as long is stale.
_INTERVAL = 60
# Before opening a database again whose tables another process may have been creating [s].
_WAITS = (0.2, 0.5, 1.0, 2.0, 5.0)
_VARIABLE = "SB3_HDS_HEARTBEAT"
_LAST = "sb3_hds:heartbeat"


class _GivenToTheZoo:
    """The zoo asks any storage for ``endswith(".log")``, and passes it on if it does not."""

    def endswith(self, suffix: str) -> bool:
        return False


class Database(_GivenToTheZoo, RDBStorage):
    """
    A database with heartbeats by its own clock.

    :param url: of SQLAlchemy, such as ``postgresql+psycopg://user:password@host/name``
    :param interval: between two heartbeats [s]
    """

    def __init__(self, url: str, interval: int) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ExperimentalWarning)
            super().__init__(
                url,
                heartbeat_interval=interval,
                heartbeat_stale_trial_callback=RetryHeartbeatStaleTrialCallback(),
            )


class Journal(_GivenToTheZoo, JournalStorage, BaseHeartbeat):
    """
    A journal file with heartbeats by the clocks of the machines, which must agree within
    ``interval``.

    :param path: of the file
    :param interval: between two heartbeats [s]
    """

    def __init__(self, path: str, interval: int) -> None:
        super().__init__(JournalFileBackend(path))
        self.interval = interval
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ExperimentalWarning)
            self._queue_again = RetryHeartbeatStaleTrialCallback()

    def record_heartbeat(self, trial_id: int) -> None:
        # Another process may have failed this trial.
        with contextlib.suppress(UpdateFinishedTrialError):
            self.set_trial_system_attr(trial_id, _LAST, time.time())

    def _get_stale_trial_ids(self, study_id: int) -> list[int]:
        running = self.get_all_trials(study_id, deepcopy=False, states=(TrialState.RUNNING,))
        oldest = time.time() - 2 * self.interval
        # Trials without any heartbeat belong to processes that record none.
        return [t._trial_id for t in running if t.system_attrs.get(_LAST, oldest) < oldest]

    def get_heartbeat_interval(self) -> int:
        return self.interval

    def get_heartbeat_stale_trial_callback(self) -> Any:
        return self._queue_again


def shared(storage: str | None, study_name: str | None) -> Any:
    """
    Open a storage, and fail stale trials of the study.

    :param storage: the zoo's ``--storage``: a URL, or a file that ends with ``.log``
    :param study_name: the zoo's ``--study-name``
    :return: a storage for the zoo's ``ExperimentManager.storage``; None for None
    :raises ValueError: if ``SB3_HDS_HEARTBEAT`` is not a number of seconds
    """
    if storage is None:
        return None
    if storage.endswith(".log"):
        os.makedirs(os.path.dirname(storage) or ".", exist_ok=True)
        opened: Any = Journal(storage, _interval())
    else:
        opened = _database(storage, _interval())
    if study_name in (study.study_name for study in opened.get_all_studies()):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ExperimentalWarning)
            study = optuna.load_study(study_name=study_name, storage=opened)
            optuna.storages.fail_stale_trials(study)
    return opened


def _database(url: str, interval: int) -> Database:
    """Of processes that create the tables of an empty database together, all but one fail."""
    for wait in _WAITS:
        try:
            return Database(url, interval)
        except (IntegrityError, ProgrammingError):
            time.sleep(wait)
    return Database(url, interval)


def _interval() -> int:
    given = os.environ.get(_VARIABLE) or str(_INTERVAL)
    if not given.isdigit() or not int(given):
        raise ValueError(
            f"{_VARIABLE} is the number of seconds between two heartbeats of a trial, at least 1, "
            f"got '{given}'."
        )
    return int(given)
