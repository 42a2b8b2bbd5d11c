"""
An import hook that extends ``rl_zoo3`` when it is imported.

``rl_zoo3`` keeps its algorithms in a module-level dictionary and reads it when a command starts,
so they have to be there before the command runs any code of ours. ``sb3_hds.pth`` (``.start`` from
Python 3.15 on) therefore calls :func:`start` in every interpreter of the environment, which puts
one object on ``sys.meta_path`` and imports nothing.
"""

import os
import sys

_TARGETS = (
    "rl_zoo3.utils",
    "rl_zoo3.hyperparams_opt",
    "rl_zoo3.exp_manager",
    "huggingface_sb3.push_to_hub",
    "huggingface_sb3.load_from_hub",
)


class _ZooFinder:
    """Finds the targets by the other finders, and extends them once they have run."""

    def __init__(self):
        self._searching = set()

    def find_spec(self, name, path=None, target=None):
        if name not in _TARGETS or name in self._searching:
            return None
        self._searching.add(name)  # other hooks may ask all finders, including this one
        try:
            spec = self._ask_the_others(name, path, target)
        finally:
            self._searching.discard(name)
        if spec is not None:
            _extend_after_execution(spec)
        return spec

    def _ask_the_others(self, name, path, target):
        for finder in sys.meta_path:
            find = None if finder is self else getattr(finder, "find_spec", None)
            spec = find(name, path, target) if find else None
            if spec is not None:
                return spec
        return None


def start() -> None:
    """Run at the start of an interpreter. ``SB3_HDS_NO_ZOO=1`` switches it off."""
    if os.environ.get("SB3_HDS_NO_ZOO", "0") in ("", "0"):
        install()


def install() -> None:
    """Extend the modules of ``rl_zoo3`` that are imported already, and the others on import."""
    if any(isinstance(finder, _ZooFinder) for finder in sys.meta_path):
        return
    sys.meta_path.insert(0, _ZooFinder())
    for name in _TARGETS:
        if name in sys.modules and not _is_executing(sys.modules[name]):
            _extend(sys.modules[name])


def _is_executing(module) -> bool:
    return getattr(getattr(module, "__spec__", None), "_initializing", False)


def _extend_after_execution(spec) -> None:
    execute = spec.loader.exec_module

    def execute_and_extend(module):
        execute(module)
        _extend(module)

    spec.loader.exec_module = execute_and_extend


def _extend(module) -> None:
    """Extend a module; a failure is only a warning, since the zoo works without us."""
    try:
        from rl_zoo_plugin import tables

        tables.EXTENSIONS[module.__name__](module)
    except Exception as error:
        import warnings

        warnings.warn(
            f"sb3_hds could not extend {module.__name__}: {type(error).__name__}: {error}. Its "
            "algorithms are missing from this rl_zoo3. SB3_HDS_NO_ZOO=1 stops it from trying.",
            RuntimeWarning,
        )
