"""Fixtures that every test module may use."""

import gc
import itertools
import os
import pickle
import tempfile
from pathlib import Path

# All processes of the tests share a compilation cache, also those that they start.
_FOLDER = tempfile.TemporaryDirectory(prefix="sb3_hds_tests_")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", _FOLDER.name)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")
# Optimise for compile time, which this halves: the programs run only for moments.
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
    """Optimise for compile time: the programs run only for moments."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture
def no_pickle(monkeypatch):
    """Unpickling anything fails from now on, except for tensors that torch loads safely."""

    def refuse(*_, **__):
        raise AssertionError("something was unpickled")

    for module in (pickle, cloudpickle):
        for name in ("load", "loads"):
            monkeypatch.setattr(module, name, refuse)


class Cluster:
    """Two nodes on this machine, each with two cores to give."""

    def __init__(self) -> None:
        from ray.cluster_utils import Cluster as Nodes

        node = {"num_cpus": 2, "memory": 4 * 2**30, "object_store_memory": 80 * 2**20}
        self.nodes = Nodes(initialize_head=True, head_node_args=node)
        self.second = self.nodes.add_node(**node)
        self.nodes.wait_for_nodes()

    @property
    def address(self):
        return self.nodes.address

    def lose_one(self):
        self.nodes.remove_node(self.second, allow_graceful=False)


@pytest.fixture
def cluster():
    pytest.importorskip("ray")
    try:
        made = Cluster()
    except (OSError, RuntimeError) as error:
        pytest.skip(f"Ray does not start on this machine: {error}")
    yield made
    made.nodes.shutdown()


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


# Slow files with few tests: a worker that got one of them last would delay the end.
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
