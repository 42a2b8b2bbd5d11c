"""
Functions of NumPy inside compiled programs.

``jax.pure_callback`` does the same at ten times the overhead: it turns every argument into an array
of JAX on the thread of the callback, where it also rounds double precision to single, and where it
may wait for the very thread that it runs on.
"""

from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jaxtyping import Array, Float

#: ``(n, n_in)`` to ``(n, n_out)``, in double precision
Function: TypeAlias = Callable[[np.ndarray], np.ndarray]
Row: TypeAlias = Float[Array, " n"]


def on_host(function: Function, size: int, row: Row) -> Float[Array, " size"]:
    """
    Call a function of NumPy from a compiled program. Under ``vmap``, all rows go in one call.

    The function must not use JAX, and has no derivative: give it one by ``jax.custom_jvp``.

    :param function: of many rows, in double precision; must always be the same object for a program
        to be compiled once
    :param size: length of a row that it returns
    :param row: shape ``(n_in,)``, in single or double precision
    :return: shape ``(size,)``, in the precision of ``row``
    """
    if row.dtype != jnp.float64:
        return _host.bind(row, function=function, size=size)
    # JAX rounds what a callback returns to single precision unless `jax.enable_x64()` holds on its
    # thread too. It leaves bits alone.
    bits = jax.lax.bitcast_convert_type(row, jnp.uint32)
    found = _host.bind(bits.reshape(-1), function=function, size=2 * size)
    return jax.lax.bitcast_convert_type(found.reshape(size, 2), jnp.float64)


_host = Primitive("sb3_hds_on_host")


def _in_rows(function: Function, given: Any) -> np.ndarray:
    """Call the function with all leading axes as one, in double precision."""
    given = np.asarray(given)
    double = given.dtype == np.uint32
    rows = np.ascontiguousarray(given).view(np.float64) if double else given.astype(np.float64)
    lead = rows.shape[:-1]
    found = function(rows.reshape(-1, rows.shape[-1])).reshape(*lead, -1)
    return np.ascontiguousarray(found).view(np.uint32) if double else found.astype(np.float32)


@_host.def_abstract_eval
def _shape(row: Any, *, function: Function, size: int) -> ShapedArray:
    return ShapedArray((*row.shape[:-1], size), row.dtype)


@_host.def_impl
def _call(row: Any, *, function: Function, size: int) -> Array:
    return jnp.asarray(_in_rows(function, row))


def _batch(rows: Any, axes: Any, *, function: Function, size: int) -> tuple[Any, int]:
    return _host.bind(jnp.moveaxis(rows[0], axes[0], 0), function=function, size=size), 0


def _lower(context: Any, row: Any, *, function: Function, size: int) -> Any:
    def call(given: Any) -> tuple[np.ndarray]:
        return (_in_rows(function, given),)

    results, _, _ = mlir.emit_python_callback(
        context,
        call,
        None,
        [row],
        context.avals_in,
        context.avals_out,
        has_side_effect=False,
        returns_token=False,
    )
    return results


batching.primitive_batchers[_host] = _batch
mlir.register_lowering(_host, _lower)
