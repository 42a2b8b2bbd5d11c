"""Tables of cases."""

import inspect
from collections.abc import Callable
from typing import Any

import pytest


def each(*rows: Any, **options: Any) -> Callable[[Callable[..., None]], Any]:
    """
    Parametrise a test by its first arguments.

    :param rows: one for each case: a tuple with a value for each argument, a ``pytest.param``, or
        the value of a single argument that is no tuple
    :param options: of ``pytest.mark.parametrize``
    """
    first = rows[0].values if isinstance(rows[0], type(pytest.param())) else rows[0]

    def parametrised(test: Callable[..., None]) -> Any:
        names = list(inspect.signature(test).parameters)
        columns = names[: len(first)] if isinstance(first, tuple) else names[0]
        return pytest.mark.parametrize(columns, rows, **options)(test)

    return parametrised
