"""Fixtures that every test module may use."""

import gc
import itertools
import os
import pickle
import tempfile
from pathlib import Path

# Programs that one process has compiled serve the others: workers and what they start inherit it.
_FOLDER = tempfile.TemporaryDirectory(prefix="sb3_hds_tests_")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", _FOLDER.name)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")
# Programs that run for moments need not be fast: these take half as long to compile.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0 "
    "--xla_llvm_disable_expensive_passes=true",
)

import cloudpickle  # noqa: E402
import jax  # noqa: E402
import pytest  # noqa: E402


@pytest.fixture
def x64():
    """Double precision inside one test; the package itself never changes the global setting."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def quick_compilation():
    """Compile for the compiler's sake: programs that run for moments need not be fast."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture
def no_pickle(monkeypatch):
    """Whatever is unpickled from now on fails, but for the tensors that torch vouches for."""

    def refuse(*_, **__):
        raise AssertionError("something was unpickled")

    for module in (pickle, cloudpickle):
        for name in ("load", "loads"):
            monkeypatch.setattr(module, name, refuse)


_MAPS = Path("/proc/self/maps")
_MOST_MAPS = 20_000
_since_look = itertools.count(1)


@pytest.fixture(autouse=True)
def few_programs():
    """Drop compiled programs before Linux runs out of memory maps for them.

    Each takes some; beyond ``vm.max_map_count`` (65,530) XLA cannot allocate, then crashes.
    """
    yield
    if next(_since_look) % 10 or not _MAPS.exists():
        return
    if _MAPS.read_bytes().count(b"\n") > _MOST_MAPS:
        jax.clear_caches()
        gc.collect()


# Few tests, much time: a worker that gets such a file last keeps everybody waiting.
_LONG = (
    "test_hidden_effects.py",
    "test_zoo.py",
    "test_diagnose.py",
    "test_hds_data.py",
    "test_effects.py",
    "test_twin_algos.py",
    "test_planning.py",
    "test_calibrate.py",
    "test_zoo_plugin.py",
    "test_neural_force.py",
    "test_docs.py",
)


def pytest_collection_modifyitems(items):
    """The longest files first."""
    order = {name: place for place, name in enumerate(_LONG)}
    items.sort(key=lambda item: order.get(item.path.name, len(_LONG)))
