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
