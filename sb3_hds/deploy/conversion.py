"""Functions of JAX and modules of torch as ONNX models, by the converters of those libraries."""

import contextlib
import io
import logging
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal

from sb3_hds.errors import ExportError

#: of the operators, and of the file: onnxruntime 1.14 (February 2023) reads both
OPSET, IR_VERSION = 18, 8
BATCH = "batch"
# Calls whose content is evaluated in their place.
_CALLS = ("jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call")


class Port(NamedTuple):
    """
    An input or an output.

    :param shape: without the axis of the batch
    :param dtype: as NumPy names it
    """

    name: str
    shape: tuple[int, ...]
    dtype: str


def from_jax(
    function: Callable[..., tuple[Any, ...]],
    inputs: Sequence[Port],
    outputs: Sequence[str],
    *,
    inlined: bool,
) -> Any:
    """
    :param function: of arrays with a leading axis, to a tuple of those
    :param inlined: whether jax2onnx sees single operations instead of layers of flax, which it
        writes shorter, but can neither map nor evaluate in double precision
    :return: an ``onnx.ModelProto``
    :raises ExportError: for an operation that jax2onnx does not know
    :raises ImportError: without the extra ``onnx``
    """
    to_onnx = _jax2onnx()
    double = any(port.dtype == "float64" for port in inputs)
    with _quiet(), jax.enable_x64(double):
        batch = jax.export.symbolic_shape(BATCH)
        given = [jax.ShapeDtypeStruct((*batch, *p.shape), np.dtype(p.dtype)) for p in inputs]
        converted = _inlined(function, given) if inlined else function
        try:
            return to_onnx(
                converted,
                given,
                model_name="policy",
                opset=OPSET,
                enable_double_precision=double,
                input_names=[port.name for port in inputs],
                output_names=list(outputs),
            )
        except (NotImplementedError, KeyError) as error:
            reason = str(error).strip().partition("\n")[0]
            raise ExportError(
                f"jax2onnx cannot convert this policy ({reason}). If it has an activation function "
                "of your own, write it with functions of jax.numpy, or use one of jax.nn."
            ) from error


def from_torch(module: Any, inputs: Sequence[Port], outputs: Sequence[str]) -> Any:
    """
    :param module: a ``torch.nn.Module`` of arrays with a leading axis
    :return: an ``onnx.ModelProto``
    :raises ExportError: for an operation that torch does not export
    :raises ImportError: without the extra ``onnx``
    """
    import torch as th

    onnx = _onnx()
    example = tuple(th.zeros((2, *p.shape), dtype=getattr(th, p.dtype)) for p in inputs)
    names = [port.name for port in inputs]
    file = io.BytesIO()
    with _quiet():
        try:
            # The exporter that traces: torch.export refuses the checks of torch's distributions.
            th.onnx.export(
                module.eval(),
                example,
                file,  # type: ignore[arg-type]  # its annotation leaves out files
                dynamo=False,
                opset_version=OPSET,
                input_names=names,
                output_names=list(outputs),
                dynamic_axes={name: {0: BATCH} for name in (*names, *outputs)},
            )
        except (RuntimeError, th.onnx.errors.OnnxExporterError) as error:
            reason = str(error).strip().partition("\n")[0]
            raise ExportError(f"torch cannot export this policy ({reason}).") from error
    return onnx.load_from_string(file.getvalue())


def _jax2onnx() -> Any:
    try:
        from jax2onnx import to_onnx
    except ImportError as error:
        raise _missing("jax2onnx") from error
    return to_onnx


def _onnx() -> Any:
    try:
        import onnx
    except ImportError as error:
        raise _missing("onnx") from error
    return onnx


def _missing(name: str) -> ImportError:
    return ImportError(f"Exporting policies needs {name}: pip install 'sb3-hds[onnx]'.")


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Both converters report on standard output and by warnings what only they can change."""
    loggers = [logging.getLogger(name) for name in ("jax2onnx", "onnx_ir", "onnx_ir.serde")]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)


def _inlined(function: Callable[..., Any], given: Sequence[Any]) -> Callable[..., Any]:
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*given)
    structure = jax.tree.structure(shape)
    return lambda *values: jax.tree.unflatten(structure, _evaluate(closed, values))


def _evaluate(closed: Any, arguments: Sequence[Any]) -> list[Any]:
    """
    What a traced function computes, in operations that are exact in the file: jax2onnx 0.17
    converts ``rem`` for fixed shapes only (``ir.Shape`` of a symbolic batch, in its
    ``plugins/jax/lax/rem.py``), and onnxruntime has ``Atan`` in single precision only.
    """
    jaxpr = closed.jaxpr
    known = dict(zip(jaxpr.constvars, closed.consts, strict=True))
    known |= dict(zip(jaxpr.invars, arguments, strict=True))

    def read(variable: Any) -> Any:
        return variable.val if isinstance(variable, Literal) else known[variable]

    for equation in jaxpr.eqns:
        values = [read(variable) for variable in equation.invars]
        primitive, inner = equation.primitive, equation.params
        if primitive.name == "rem":
            found = [values[0] - values[1] * jnp.trunc(values[0] / values[1])]
        elif primitive.name == "atan2" and values[0].dtype == jnp.float64:
            found = [_double_atan2(*values)]
        elif primitive.name in _CALLS:
            found = _evaluate(inner.get("jaxpr") or inner["call_jaxpr"], values)
        else:
            result = primitive.bind(*values, **inner)
            found = result if primitive.multiple_results else [result]
        known |= dict(zip(equation.outvars, found, strict=True))
    return [read(variable) for variable in jaxpr.outvars]


def _double_atan2(y: jax.Array, x: jax.Array) -> jax.Array:
    """From single precision by one step of Newton's method, whose error is cubic."""
    rough = jnp.arctan2(y.astype(jnp.float32), x.astype(jnp.float32)).astype(jnp.float64)
    radius = jnp.sqrt(x * x + y * y)
    away = (y * jnp.cos(rough) - x * jnp.sin(rough)) / jnp.where(radius > 0.0, radius, 1.0)
    return rough + away


# --- what ONNX says of its own operations


def attributes_of(node: Any) -> dict[str, Any]:
    """:return: of one operation, by name"""
    from onnx import helper

    found = {part.name: helper.get_attribute_value(part) for part in node.attribute}
    return {k: v.decode() if isinstance(v, bytes) else v for k, v in found.items()}


def numpy_type(kind: int) -> Any:
    """:return: the type of NumPy of a type of ONNX"""
    from onnx import helper

    return helper.tensor_dtype_to_np_dtype(kind)


def evaluated(node: Any, given: Sequence[np.ndarray], opset: Sequence[Any]) -> list[Any]:
    """:return: what an operation does to these arrays, by ONNX's own reference"""
    from onnx import TensorProto, helper
    from onnx.reference import ReferenceEvaluator

    names = [f"x{i}" for i in range(len(given))]
    copy = type(node)()
    copy.CopyFrom(node)
    filled = iter(names)
    inputs = [next(filled) if name else "" for name in node.input]
    del copy.input[:]
    copy.input.extend(inputs)
    kind = TensorProto.INT64
    graph = helper.make_graph(
        [copy],
        "one",
        [helper.make_tensor_value_info(name, kind, None) for name in names],
        [helper.make_tensor_value_info(name, kind, None) for name in node.output],
    )
    model = helper.make_model(graph, opset_imports=opset)
    return ReferenceEvaluator(model).run(None, dict(zip(names, given, strict=True)))  # type: ignore[return-value]
