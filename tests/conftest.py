"""Fixtures that every test module may use."""

import jax
import pytest


@pytest.fixture
def x64():
    """Double precision inside one test; the package itself never changes the global setting."""
    with jax.enable_x64(True):
        yield
