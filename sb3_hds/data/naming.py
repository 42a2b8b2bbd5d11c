"""Names of what a log holds, before anyone says which signals of a twin they are."""

import dataclasses
import os
from collections.abc import Iterable

import numpy as np

from sb3_hds.data.columns import Columns, Entry, columns_from
from sb3_hds.data.load import Files, first_log
from sb3_hds.data.overview import guessed_time


@dataclasses.dataclass(frozen=True)
class Named:
    """
    :param observed: what may be an observation, or anything
    :param commanded: what is known to be a command
    :param rest: the map of columns without these two: time, episodes, the label
    :param guessed: sentences on what nobody said
    """

    observed: tuple[Entry, ...]
    commanded: tuple[Entry, ...]
    rest: Columns
    guessed: tuple[str, ...] = ()

    def chosen(self, obs: Iterable[str], actions: Iterable[str]) -> Columns:
        """
        :param obs: names of entries, in the order of a twin's channels
        :param actions: likewise, of its actuators
        :return: what ``Trajectories.load`` takes
        """
        known = {entry.name: entry for entry in (*self.observed, *self.commanded)}
        commands = known | {entry.name: entry for entry in self.commanded}
        return dataclasses.replace(
            self.rest,
            obs=tuple(known[name] for name in obs),
            actions=tuple(commands[name] for name in actions),
        )


def names_in(files: Files, columns: str | os.PathLike[str] | dict | None = None) -> Named | None:
    """
    :param files: as for ``Trajectories.load``; the first of them is asked
    :param columns: a map, whose ``obs`` and ``actions`` may be left out
    :return: None for a file that ``Trajectories.save`` wrote, which has no names
    :raises TrajectoryError: if it cannot be read
    """
    said = Columns() if columns is None else columns_from(columns)
    log = first_log(files, None if columns is None else said)
    if log is None:
        return None
    own = log.columns or Columns()
    fields = [field.name for field in dataclasses.fields(Columns)]
    unsaid = {name: getattr(own, name) for name in fields if getattr(said, name) is None}
    merged = dataclasses.replace(said, **unsaid)
    guessed = []
    if merged.time is None and merged.dt is None:
        entry = guessed_time(log)
        if entry is not None:
            merged = dataclasses.replace(merged, time=(entry,))
            unit = f" in {entry.unit}" if entry.unit else ""
            guessed.append(f"Time is taken from '{entry.column}'{unit}.")
    table = log.tables[0]
    taken = {entry.column for entry in (*(merged.obs or ()), *(merged.actions or ()))}
    every = tuple(
        Entry(name, name)
        for name, values in table.items()
        if np.ndim(values) and values.dtype.kind in "iuf" and name not in taken
    )
    return Named(
        every if merged.obs is None else merged.obs,
        (merged.actions or ()) if merged.obs is not None or merged.actions else (),
        dataclasses.replace(merged, obs=None, actions=None),
        tuple(guessed),
    )
