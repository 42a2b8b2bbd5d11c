"""Packages whose names are imported on first use."""

import builtins
import contextlib
import importlib
import importlib.util
import sys
import threading
from collections.abc import Iterator, Mapping
from types import ModuleType, SimpleNamespace
from typing import Any


class _Package(ModuleType):
    """
    A package with lazily imported names. If a public name is also that of a submodule
    (``data.audit``), importing the submodule does not replace it, as it would in Python.
    """

    _public: Mapping[str, str]

    def __getattr__(self, name: str) -> Any:
        if name not in self._public:
            raise AttributeError(f"module '{self.__name__}' has no attribute '{name}'")
        value = getattr(importlib.import_module(self._public[name]), name)
        self.__dict__[name] = value
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in self._public and isinstance(value, ModuleType)):
            super().__setattr__(name, value)

    def __dir__(self) -> list[str]:
        return sorted(self._public)


@contextlib.contextmanager
def lazy_imports(package: str) -> Iterator[None]:
    """
    Postpone the imports in a ``with`` block of a package's ``__init__``: ``from M import A`` there
    imports ``M`` when ``A`` is first used.

    :param package: its name
    """
    module: Any = sys.modules[package]
    homes: dict[str, str] = {}

    def record(name: str, *arguments: Any, **keywords: Any) -> Any:
        if not (arguments and arguments[0] is module.__dict__):  # of another module, in a thread
            return usual(name, *arguments, **keywords)
        names = arguments[2]
        homes.update(dict.fromkeys(names, name))
        return SimpleNamespace(**dict.fromkeys(names))

    with _patching:
        usual, builtins.__import__ = builtins.__import__, record
        try:
            yield
        finally:
            builtins.__import__ = usual
    for name in homes:
        del module.__dict__[name]
    module.__dict__["_public"] = homes
    module.__class__ = _Package


# Two locks: what runs under the second one may import packages that need the first one.
_patching, _one_at_a_time = threading.RLock(), threading.RLock()


class _Postponed(ModuleType):
    """A package whose ``__init__`` runs when a name other than a submodule's is first used."""

    def __getattr__(self, name: str) -> Any:
        spec: Any = self.__spec__
        package: Any = self
        with _one_at_a_time:
            if type(self) is _Postponed and not self.__dict__.get("_running"):
                self.__dict__["_running"] = True
                try:
                    spec.loader.exec_module(self)
                finally:
                    del self.__dict__["_running"]
                package.__class__ = ModuleType
        if name in self.__dict__:
            return self.__dict__[name]
        raise AttributeError(f"module '{self.__name__}' has no attribute '{name}'")


def postpone(package: str) -> None:
    """
    Allow to import submodules of a package without running its ``__init__``, which runs when one of
    the package's own names is first used. No effect if it has run, or without such a package.

    :param package: its name
    """
    if package in sys.modules:
        return
    spec = importlib.util.find_spec(package)
    if spec is None or spec.loader is None or spec.submodule_search_locations is None:
        return
    module = importlib.util.module_from_spec(spec)
    module.__class__ = _Postponed
    sys.modules[package] = module
