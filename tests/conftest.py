"""Fixtures that every test module may use."""

import jax
import pytest


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


# Few tests, much time: a worker that gets such a file last keeps everybody waiting.
_LONG = (
    "test_diagnose.py",
    "test_hds_data.py",
    "test_calibrate.py",
    "test_zoo_plugin.py",
    "test_neural_force.py",
    "test_docs.py",
)


def pytest_collection_modifyitems(items):
    """The longest files first."""
    order = {name: place for place, name in enumerate(_LONG)}
    items.sort(key=lambda item: order.get(item.path.name, len(_LONG)))
