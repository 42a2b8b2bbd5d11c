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
#: them, and they run no faster. (Matrix products do.)
QUICK_COMPILATION = {"xla_cpu_use_fusion_emitters": False}

#: For programs that run a few hundred times at most: they compile in a half to five sixths of the
#: time, and run more slowly, large ones most.
QUICKEST_COMPILATION = QUICK_COMPILATION | {
    "xla_backend_optimization_level": 1,
    "xla_llvm_disable_expensive_passes": True,
}

#: the random number generator that XLA compiles fastest
GENERATOR = "unsafe_rbg"

_SWITCH = "SB3_HDS_CACHE"
# Total size of all files [bytes]; the least recently used ones are deleted.
_MAX_SIZE = 256 * 2**20
# Check the total size each time that this many bytes have been written.
_CHECK_EVERY = _MAX_SIZE // 32
_DIGEST_SIZE = 16  # [bytes]
# Delete temporary files of this age: the process that wrote them was interrupted [s].
_ABANDONED = 3600.0
_SUFFIX, _UNFINISHED = ".xla", ".tmp"
# JAX keeps programs that took a second to compile; most of those at start-up take less.
_DIR, _SECONDS, _USUAL_SECONDS = (
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    1.0,
)
# Folders that were set here, not by the user.
_folders: set[str] = set()


def cache_compiled_programs() -> Path | None:
    """
    Cache what JAX compiles in ``~/.cache/sb3_hds/xla`` from now on.

    The environment variable ``SB3_HDS_CACHE`` names another folder; empty, it switches this off.
    A folder set in JAX (``JAX_COMPILATION_CACHE_DIR``, ``jax_compilation_cache_dir``) takes
    precedence, and so does ``jax_enable_compilation_cache=False``.

    :return: the folder; None if this cache is not used
    """
    given = os.environ.get(_SWITCH)
    held = jax.config.values.get(_DIR)
    if held is not None:
        return Path(held) if held in _folders else None
    if given == "" or not jax.config.values.get("jax_enable_compilation_cache", True):
        return None
    caches = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(given).expanduser() if given else Path(caches, "sb3_hds", "xla")
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError:
        return None
    if not (os.access(folder, os.R_OK | os.W_OK) and _hook_into_jax()):
        return None
    _folders.add(str(folder))
    jax.config.update(_DIR, str(folder))
    if jax.config.values.get(_SECONDS) == _USUAL_SECONDS:
        jax.config.update(_SECONDS, 0.0)
    return folder


@functools.cache
def _hook_into_jax() -> bool:
    """
    Make JAX use :class:`Programs` for our folders. How it opens one is private to JAX.

    :return: False if this version of JAX opens folders in another way: then nothing is cached
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
    Compiled programs by key, one file each. Several processes may read and write at the same time.
    JAX's keys leave out the instruction set of the processor, so it is part of the file names.

    :param folder: of the files
    :param max_size: of all files together [bytes]
    """

    def __init__(self, folder: Path, max_size: int = _MAX_SIZE) -> None:
        self._path = folder
        self._max_size = max_size
        self._unchecked = _CHECK_EVERY

    def get(self, key: str) -> bytes | None:
        """:return: the program; None if there is none, or its file is damaged"""
        path = self._file(key)
        with contextlib.suppress(OSError):
            stored = path.read_bytes()
            program = stored[_DIGEST_SIZE:]
            if stored[:_DIGEST_SIZE] == _digest(program):
                with contextlib.suppress(OSError):
                    os.utime(path)
                return program
            path.unlink()
        return None

    def put(self, key: str, program: bytes) -> None:
        """Write a program, or replace it; errors of the file system are ignored."""
        with contextlib.suppress(OSError):
            write_bytes(self._file(key), _digest(program) + program)
            self._unchecked += len(program)
            if self._unchecked >= _CHECK_EVERY:
                self._unchecked = 0
                self._delete_old_files()

    def _file(self, key: str) -> Path:
        return self._path / f"{key}-{_processor()}{_SUFFIX}"

    def _delete_old_files(self) -> None:
        found, abandoned = [], time.time() - _ABANDONED
        with os.scandir(self._path) as entries:
            for entry in entries:
                with contextlib.suppress(OSError):
                    stat = entry.stat()
                    if entry.name.endswith(_SUFFIX):
                        found.append((stat.st_mtime, stat.st_size, entry.path))
                    elif entry.name.endswith(_UNFINISHED) and stat.st_mtime < abandoned:
                        os.unlink(entry.path)
        total = 0
        for _, size, path in sorted(found, reverse=True):
            total += size
            if total > self._max_size:
                with contextlib.suppress(OSError):
                    os.unlink(path)


def _digest(program: bytes) -> bytes:
    return hashlib.blake2b(program, digest_size=_DIGEST_SIZE).digest()


@functools.cache
def _processor() -> str:
    """:return: a hash of the processor's instruction set"""
    try:
        with open("/proc/cpuinfo", "rb") as file:
            lines = file.read(16_384).splitlines()
        wanted = (b"model name", b"flags", b"Features", b"CPU part")
        described = str(sorted({line for line in lines if line.startswith(wanted)}))
    except OSError:
        described = platform.processor()
    described += platform.machine()
    return hashlib.blake2b(described.encode(), digest_size=4).hexdigest()
