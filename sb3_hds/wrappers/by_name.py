"""Functions by their dotted name, as yml files hold them."""

import importlib
from collections.abc import Callable
from typing import Any

from sb3_hds.errors import ParameterError


def function_of(name: str) -> Callable[..., Any]:
    """
    :param name: ``"package.module.function"``, as a yml file can hold it
    :raises ParameterError: if there is no such function
    """
    module, _, attribute = name.replace(":", ".").rpartition(".")
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ParameterError(f"There is no function '{name}' to import: {error}.") from error
    if not callable(found):
        raise ParameterError(f"'{name}' is {found!r}, which is no function.")
    return found
