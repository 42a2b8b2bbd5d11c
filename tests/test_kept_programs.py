"""Compiled programs that outlive the process."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import jax
import pytest
from cases import each

from sb3_hds.core.numerics import compilation
from sb3_hds.core.numerics.compilation import Programs, cache_compiled_programs

SETTINGS = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
OF_USERS = ("JAX_COMPILATION_CACHE_DIR", "SB3_HDS_CACHE", "XDG_CACHE_HOME")
MINIMUM = "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"

COUNTS = """
import collections, json, warnings
import jax
counts = collections.Counter()
jax.monitoring.register_event_listener(lambda name, **_: counts.update([name.split("/")[-1]]))
warnings.simplefilter("error")
{script}
print(json.dumps([counts["cache_hits"], counts["cache_misses"]]))
"""
#: a program of JAX's own comes first: what is compiled earlier does not keep the cache off
PLAIN = """
jax.numpy.zeros(3).block_until_ready()
from sb3_hds.core.numerics.compilation import cache_compiled_programs
cache_compiled_programs()
assert jax.jit(lambda x: 2.0 * x + 1.0)(3.0) == 7.0
"""
CONSTRUCTED = """
from sb3_hds import DroQ
DroQ("Pendulum-v1", policy_kwargs={"net_arch": [4]}).predict([0.0, 1.0, 0.0])
"""


@pytest.fixture
def fresh_settings(monkeypatch):
    """JAX as a user finds it who has set nothing."""
    for name in OF_USERS:
        monkeypatch.delenv(name, raising=False)
    before = {name: jax.config.values[name] for name in SETTINGS}
    jax.config.update("jax_compilation_cache_dir", None)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)
    yield
    for name, value in before.items():
        jax.config.update(name, value)


def counted(script: str, folder: Path) -> tuple[int, int]:
    """:return: of a process, how many programs were there, and how many it put there"""
    left = {name: value for name, value in os.environ.items() if name not in (*OF_USERS, MINIMUM)}
    command = [sys.executable, "-c", COUNTS.format(script=script)]
    environ = left | {"SB3_HDS_CACHE": str(folder)}
    done = subprocess.run(command, env=environ, text=True, capture_output=True)
    assert done.returncode == 0, done.stderr
    hits, misses = json.loads(done.stdout.splitlines()[-1])
    return hits, misses


@each(
    ({"SB3_HDS_CACHE": "{tmp}/mine"}, "{tmp}/mine"),
    ({"XDG_CACHE_HOME": "{tmp}"}, "{tmp}/sb3_hds/xla"),
    ({"HOME": "{tmp}"}, "{tmp}/.cache/sb3_hds/xla"),
    ({"SB3_HDS_CACHE": ""}, None),
    ({"SB3_HDS_CACHE": "/proc/nowhere"}, None),
)
def test_programs_are_kept_where_the_user_wants_them(
    environ, expected, fresh_settings, monkeypatch, tmp_path
):
    for name, value in environ.items():
        monkeypatch.setenv(name, value.format(tmp=tmp_path))
    expected = expected and expected.format(tmp=tmp_path)

    assert cache_compiled_programs() == (expected and Path(expected))
    assert cache_compiled_programs() == (expected and Path(expected)), (
        "a second call changes nothing"
    )

    assert jax.config.values["jax_compilation_cache_dir"] == expected
    seconds = jax.config.values["jax_persistent_cache_min_compile_time_secs"]
    assert seconds == (0.0 if expected else 1.0)


@each("/tmp/of_jax", "")
def test_a_folder_that_jax_was_given_stays(folder, fresh_settings, monkeypatch, tmp_path):
    monkeypatch.setenv("SB3_HDS_CACHE", str(tmp_path))
    jax.config.update("jax_compilation_cache_dir", folder)

    assert cache_compiled_programs() is None
    assert jax.config.values["jax_compilation_cache_dir"] == folder


def test_nothing_is_cached_where_jax_caches_nothing(fresh_settings, monkeypatch, tmp_path):
    monkeypatch.setenv("SB3_HDS_CACHE", str(tmp_path))
    jax.config.update("jax_enable_compilation_cache", False)
    try:
        assert cache_compiled_programs() is None
    finally:
        jax.config.update("jax_enable_compilation_cache", True)
    assert jax.config.values["jax_compilation_cache_dir"] is None


def test_how_long_a_program_must_take_is_the_users_to_say(fresh_settings, monkeypatch, tmp_path):
    monkeypatch.setenv("SB3_HDS_CACHE", str(tmp_path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 5.0)

    assert cache_compiled_programs() == tmp_path
    assert jax.config.values["jax_persistent_cache_min_compile_time_secs"] == 5.0


def test_with_an_unknown_cache_of_jax_nothing_is_cached(fresh_settings, monkeypatch, tmp_path):
    from jax._src import compilation_cache

    monkeypatch.setenv("SB3_HDS_CACHE", str(tmp_path))
    monkeypatch.delattr(compilation_cache, "get_file_cache")
    compilation._hook_into_jax.cache_clear()
    try:
        assert cache_compiled_programs() is None
    finally:
        compilation._hook_into_jax.cache_clear()
    assert jax.config.values["jax_compilation_cache_dir"] is None


def test_the_second_process_compiles_nothing(tmp_path):
    hits, misses = counted(PLAIN, tmp_path)
    assert hits == 0 and misses > 0

    assert counted(PLAIN, tmp_path) == (misses, 0)


def test_a_script_that_makes_a_model_keeps_its_programs(tmp_path):
    _, misses = counted(CONSTRUCTED, tmp_path)
    assert misses > 0

    assert counted(CONSTRUCTED, tmp_path) == (misses, 0)


def test_a_damaged_program_is_compiled_again_without_a_word(tmp_path):
    """``counted`` makes errors of warnings."""
    _, misses = counted(PLAIN, tmp_path)
    for path in tmp_path.glob("*.xla"):
        stored = path.read_bytes()
        path.write_bytes(stored[:-1] + bytes([stored[-1] ^ 1]))

    assert counted(PLAIN, tmp_path) == (0, misses)
    assert counted(PLAIN, tmp_path) == (misses, 0)


@each(b"", b"short", lambda stored: stored[:-5], lambda stored: stored + b"more")
def test_what_is_not_as_it_was_written_is_not_there(damage, tmp_path):
    programs = Programs(tmp_path)
    programs.put("key", b"a program")
    [path] = tmp_path.iterdir()
    path.write_bytes(damage(path.read_bytes()) if callable(damage) else damage)

    assert programs.get("key") is None
    programs.put("key", b"a program")
    assert programs.get("key") == b"a program"


def test_programs_that_were_not_used_for_longest_make_room(tmp_path):
    programs = Programs(tmp_path, max_size=300)
    now = time.time()
    for i in range(3):
        programs.put(f"program_{i}", bytes([i]) * 100)
        [path] = tmp_path.glob(f"program_{i}-*")
        os.utime(path, (now - 100 + i, now - 100 + i))
    assert programs.get("program_0") == bytes(100)

    Programs(tmp_path, max_size=300).put("program_3", b"3" * 100)

    kept = [i for i in range(4) if programs.get(f"program_{i}") is not None]
    assert kept == [0, 3]
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= 300


def test_what_a_process_left_unfinished_goes_when_it_is_old(tmp_path):
    old, new = tmp_path / "old.tmp", tmp_path / "new.tmp"
    for path in (old, new):
        path.write_bytes(b"half")
    os.utime(old, (0.0, 0.0))

    Programs(tmp_path).put("key", b"a program")

    assert not old.exists() and new.exists()


def test_processors_with_other_instructions_do_not_share_programs(monkeypatch, tmp_path):
    programs = Programs(tmp_path)
    programs.put("key", b"for this one")
    monkeypatch.setattr(compilation, "_processor", lambda: "another")

    assert programs.get("key") is None


WRITES = """
import sys, pathlib
from sb3_hds.core.numerics.compilation import Programs
programs = Programs(pathlib.Path(sys.argv[1]))
for _ in range(200):
    programs.put("key", sys.argv[2].encode() * 300_000)
"""


def test_processes_that_write_one_program_leave_it_complete(tmp_path):
    command = [sys.executable, "-c", WRITES, str(tmp_path)]
    writers = [subprocess.Popen([*command, letter]) for letter in "ab"]
    programs, seen, path = Programs(tmp_path), set(), None
    while any(writer.poll() is None for writer in writers):
        found = programs.get("key")
        # Whoever finds damage removes the file: it would be missing once it was there.
        assert found is not None or path is None
        if found is not None:
            seen.add(found)
            [path] = tmp_path.glob("*.xla")

    assert all(writer.wait() == 0 for writer in writers)
    assert seen <= {b"a" * 300_000, b"b" * 300_000} and seen
    assert not list(tmp_path.glob("*.tmp"))
