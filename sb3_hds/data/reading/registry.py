"""The reader for each file suffix."""

from collections.abc import Callable
from pathlib import Path

from sb3_hds.data.columns import Columns
from sb3_hds.data.reading.arrays import read_npy, read_npz
from sb3_hds.data.reading.hdf5 import read_hdf5
from sb3_hds.data.reading.log import Log, aliases
from sb3_hds.data.reading.matlab import read_mat
from sb3_hds.data.reading.minari import PREFIX, read_minari
from sb3_hds.data.reading.objects import read_json
from sb3_hds.data.reading.parquet import read_parquet
from sb3_hds.data.reading.ros import is_bag, read_bag
from sb3_hds.data.reading.text import read_text
from sb3_hds.errors import TrajectoryError

READERS: dict[str, Callable[[Path, Columns], Log]] = {
    **dict.fromkeys((".csv", ".tsv", ".txt", ".dat", ".log"), read_text),
    ".parquet": read_parquet,
    ".npz": read_npz,
    ".npy": read_npy,
    ".mat": read_mat,
    **dict.fromkeys((".json", ".jsonl", ".ndjson"), read_json),
    **dict.fromkeys((".h5", ".hdf5", ".hdf"), read_hdf5),
    **dict.fromkeys((".bag", ".db3", ".mcap"), read_bag),
}
"""The reader of each suffix. Add your own readers here."""


def read_log(source: str | Path, columns: Columns) -> Log:
    """
    :param source: path, whose suffix selects the reader; a folder may be a bag of ROS 2; or
        ``minari:`` and the name of a data set
    :param columns: that will be used; if empty, all are read
    :raises TrajectoryError: if the file does not exist, is damaged, or has an unknown suffix
    """
    if str(source).startswith(PREFIX):
        return read_minari(str(source).removeprefix(PREFIX))
    path = Path(source)
    folder = is_bag(path)
    reader = read_bag if folder else READERS.get(path.suffix.lower())
    if not folder and not path.is_file():
        what = "is a folder; name the files in it, as" if path.is_dir() else "does not exist (in"
        rest = f"'{path / '*.csv'}'." if path.is_dir() else f"{Path.cwd()})."
        raise TrajectoryError(f"'{path}' {what} {rest}")
    if reader is None:
        raise TrajectoryError(
            f"'{path}' cannot be read: there are readers for {', '.join(READERS)}, but not for "
            f"'{path.suffix}'. Read it yourself and use Trajectories.from_arrays."
        )
    log = reader(path, columns)
    tables = []
    for table in log.tables:
        other = aliases(table.keys(), columns.wanted)
        tables.append({**table, **{name: table[own] for name, own in other.items()}})
    return log._replace(tables=tables)
