"""Functions and classes by their dotted name, as yml files hold them."""

import importlib
from collections.abc import Callable
from typing import Any

from sb3_hds.errors import ParameterError


def function_of(name: str) -> Callable[..., Any]:
    """
    :param name: ``"package.module.function"``, as a yml file can hold it
    :raises ParameterError: if there is no such function
    """
    found = imported(name.replace(":", "."), "function")
    if not callable(found):
        raise ParameterError(f"'{name}' is {found!r}, which is no function.")
    return found


def imported(name: str, kind: str) -> Any:
    """
    :param name: ``"package.module.Name"``
    :param kind: of object, for the message
    :raises ParameterError: if nothing of that name can be imported
    """
    module, _, attribute = name.rpartition(".")
    try:
        return getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ParameterError(f"There is no {kind} '{name}' to import: {error}.") from error
