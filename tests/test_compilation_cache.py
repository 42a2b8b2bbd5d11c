"""The folder in which commands keep compiled programs."""

import os
import subprocess
import sys

import pytest

SHOW = (
    "from rl_zoo_plugin import compilation_cache as c; c.enable(); "
    "import jax; print(jax.config.jax_compilation_cache_dir)"
)


def folder_with(**environ):
    """What JAX is told in a process of its own: the setting is global."""
    kept = {k: v for k, v in os.environ.items() if "CACHE" not in k}
    done = subprocess.run(
        [sys.executable, "-c", SHOW], env=kept | environ, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


@pytest.mark.parametrize(
    ("environ", "expected"),
    [
        ({"SB3_HDS_CACHE": "/tmp/mine"}, "/tmp/mine"),
        ({"SB3_HDS_CACHE": ""}, "None"),
        ({"XDG_CACHE_HOME": "/tmp/xdg"}, "/tmp/xdg/sb3_hds/xla"),
        ({"JAX_COMPILATION_CACHE_DIR": "/tmp/jax", "SB3_HDS_CACHE": "/tmp/mine"}, "/tmp/jax"),
    ],
    ids=["moved", "switched off", "the user's cache folder", "given to JAX already"],
)
def test_the_cache_lies_where_the_user_wants_it(environ, expected):
    assert folder_with(**environ) == expected
