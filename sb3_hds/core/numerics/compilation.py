"""
Compilation by XLA: options, and compiled programs kept between processes.

JAX decides what is the same program, and what goes into its file. It can keep files in a folder
itself, too, but that folder grows without limit unless another package is installed, a second
process may read a half-written file, and a damaged file is never replaced.
"""

import contextlib
import functools
import hashlib
import os
import platform
import time
from pathlib import Path
from typing import Any

import jax

from sb3_hds.core.trajectories.storage import write_bytes

#: For programs of many small operations: XLA's newer code generator takes a third longer to compile
#: them and they run no faster. (Matrix products do.)
QUICK_COMPILATION = {"xla_cpu_use_fusion_emitters": False}

#: For programs that run a few hundred times at most: a sixth to a half off the time to compile, and
#: more to run, the more the larger the program.
QUICKEST_COMPILATION = QUICK_COMPILATION | {
    "xla_backend_optimization_level": 1,
    "xla_llvm_disable_expensive_passes": True,
}

#: the random generator that XLA compiles fastest
GENERATOR = "unsafe_rbg"

_SWITCH = "SB3_HDS_CACHE"
# What all files together may take [bytes]; the ones that were not used for longest go.
_MOST = 256 * 2**20
# Of this many bytes written, how many files there are is looked up anew.
_OFTEN = _MOST // 32
_DIGEST = 16
# A file that is still being written after this long never will be [s].
_ABANDONED = 3600.0
_SUFFIX, _UNFINISHED = ".xla", ".tmp"
# JAX keeps what took a second to compile. Most programs of a start take less, and there are many.
_DIR, _SECONDS, _USUAL_SECONDS = (
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    1.0,
)
# Those that JAX was given here.
_folders: set[str] = set()


def keep_programs() -> Path | None:
    """
    From now on, keep what JAX compiles in ``~/.cache/sb3_hds/xla``, and take it from there.

    The environment variable ``SB3_HDS_CACHE`` names another folder; empty, it switches this off.
    Where JAX was given a folder (``JAX_COMPILATION_CACHE_DIR``, ``jax_compilation_cache_dir``) or
    told to keep nothing (``jax_enable_compilation_cache``), that stands.

    :return: the folder; None where nothing is kept by us
    """
    given = os.environ.get(_SWITCH)
    held = jax.config.values.get(_DIR)
    if held is not None:
        return Path(held) if held in _folders else None
    if given == "" or not jax.config.values.get("jax_enable_compilation_cache", True):
        return None
    folder = Path(given).expanduser() if given else _default_folder()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError:
        return None
    if not (os.access(folder, os.R_OK | os.W_OK) and _offered()):
        return None
    _folders.add(str(folder))
    jax.config.update(_DIR, str(folder))
    if jax.config.values.get(_SECONDS) == _USUAL_SECONDS:
        jax.config.update(_SECONDS, 0.0)
    return folder


@functools.cache
def _offered() -> bool:
    """
    Have JAX ask for programs here, for folders of ours. It is private to JAX how it opens one.

    :return: False where JAX does that otherwise by now: then nothing is kept
    """
    try:
        from jax._src import compilation_cache

        usual = compilation_cache.get_file_cache
    except (ImportError, AttributeError):
        return False

    def opened(path: str) -> Any:
        return (Programs(Path(path)), path) if path in _folders else usual(path)

    compilation_cache.get_file_cache = opened
    return True


class Programs:
    """
    Programs by their keys, each in a file that is whole or not there. Any number of processes may
    read and write them at a time. What takes no part in a program's key but in its code, the
    instructions that the processor has, is part of its file's name.

    :param folder: where they are
    :param most: what all of them may take [bytes]
    """

    def __init__(self, folder: Path, most: int = _MOST) -> None:
        self._path = folder
        self._most = most
        self._unseen = _OFTEN

    def get(self, key: str) -> bytes | None:
        """:return: what was put there; None where there is nothing, or it is damaged"""
        path = self._file(key)
        with contextlib.suppress(OSError):
            stored = path.read_bytes()
            program = stored[_DIGEST:]
            if stored[:_DIGEST] == _digest(program):
                with contextlib.suppress(OSError):
                    os.utime(path)
                return program
            path.unlink()
        return None

    def put(self, key: str, program: bytes) -> None:
        """Write a program, in place of one that is there; where that fails, it is not kept."""
        with contextlib.suppress(OSError):
            write_bytes(self._file(key), _digest(program) + program)
            self._unseen += len(program)
            if self._unseen >= _OFTEN:
                self._unseen = 0
                self._make_room()

    def _file(self, key: str) -> Path:
        return self._path / f"{key}-{_processor()}{_SUFFIX}"

    def _make_room(self) -> None:
        found, abandoned = [], time.time() - _ABANDONED
        with os.scandir(self._path) as entries:
            for entry in entries:
                with contextlib.suppress(OSError):
                    seen = entry.stat()
                    if entry.name.endswith(_SUFFIX):
                        found.append((seen.st_mtime, seen.st_size, entry.path))
                    elif entry.name.endswith(_UNFINISHED) and seen.st_mtime < abandoned:
                        os.unlink(entry.path)
        total = 0
        for _, size, path in sorted(found, reverse=True):
            total += size
            if total > self._most:
                with contextlib.suppress(OSError):
                    os.unlink(path)


def _digest(program: bytes) -> bytes:
    return hashlib.blake2b(program, digest_size=_DIGEST).digest()


@functools.cache
def _processor() -> str:
    """:return: the same on machines whose processors have the same instructions"""
    try:
        with open("/proc/cpuinfo", "rb") as file:
            lines = file.read(16_384).splitlines()
        wanted = (b"model name", b"flags", b"Features", b"CPU part")
        described = str(sorted({line for line in lines if line.startswith(wanted)}))
    except OSError:
        described = platform.processor()
    described += platform.machine()
    return hashlib.blake2b(described.encode(), digest_size=4).hexdigest()


def _default_folder() -> Path:
    caches = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(caches, "sb3_hds", "xla")
