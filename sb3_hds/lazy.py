"""Packages whose names are imported on first use."""

import importlib
import sys
from collections.abc import Mapping
from types import ModuleType
from typing import Any


class _Package(ModuleType):
    """
    A public name may be that of a submodule, too (``data.audit``): it stays what it stands for
    when the submodule is imported, which Python would put in its place.
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


def lazily(package: str, public: Mapping[str, str]) -> None:
    """
    Called at the end of a package's ``__init__``.

    :param package: its name
    :param public: names, and the module that each is imported from
    """
    module: Any = sys.modules[package]
    module.__dict__["_public"] = dict(public)
    module.__class__ = _Package
