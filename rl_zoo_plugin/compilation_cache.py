"""Compiled programs kept between two commands, so that the second one starts training sooner."""

import os
from pathlib import Path

_SWITCH = "SB3_HDS_CACHE"


def enable() -> None:
    """
    Let JAX keep what it compiles in a folder of the user's.

    ``SB3_HDS_CACHE`` moves the folder; empty, it switches the cache off. A folder that JAX was
    already given (``JAX_COMPILATION_CACHE_DIR``) stays.
    """
    folder = os.environ.get(_SWITCH, str(_default_folder()))
    if not folder or os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return
    import jax

    if jax.config.values.get("jax_compilation_cache_dir") is None:
        jax.config.update("jax_compilation_cache_dir", folder)


def _default_folder() -> Path:
    caches = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(caches, "sb3_hds", "xla")
