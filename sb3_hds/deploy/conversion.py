"""Functions of JAX and policies of torch as ONNX models, by the converters of those libraries."""

import contextlib
import io
import logging
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch as th
from gymnasium import spaces
from jax.extend.core import Literal

from sb3_hds.deploy.observations import SINGLE, Normalization, Port, parts_of
from sb3_hds.errors import ExportError

#: versions of operators and file format, which onnxruntime 1.14 (February 2023) reads
OPSET, IR_VERSION = 18, 8
BATCH = "batch"
# Calls to inline.
_CALLS = ("jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call")


def from_jax(
    function: Callable[..., tuple[Any, ...]],
    inputs: Sequence[Port],
    outputs: Sequence[str],
    *,
    inlined: bool,
) -> Any:
    """
    :param function: from arrays with a leading axis to a tuple of them
    :param inlined: whether to convert single operations instead of layers of flax, which are
        shorter, but support neither ``vmap`` nor double precision
    :return: an ``onnx.ModelProto``
    :raises ExportError: for an operation that jax2onnx does not support
    :raises ImportError: without the extra ``onnx``
    """
    try:
        from jax2onnx import to_onnx
    except ImportError as error:
        raise _missing("jax2onnx") from error
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
                f"jax2onnx cannot convert this policy ({reason}). If it has a custom activation "
                "function, write it with functions of jax.numpy, or use one of jax.nn."
            ) from error


def from_torch(
    policy: Any,
    inputs: Sequence[Port],
    outputs: Sequence[str],
    by: Mapping[str, Normalization],
) -> Any:
    """
    :param policy: of Stable-Baselines3
    :param inputs: one for each part of an observation
    :param by: normalisation of its observations
    :return: an ``onnx.ModelProto``
    :raises ExportError: for an operation that torch cannot export
    :raises ImportError: without the extra ``onnx``
    """
    try:
        import onnx
    except ImportError as error:
        raise _missing("onnx") from error
    policy.set_training_mode(False)
    keys = list(parts_of(policy.observation_space))
    module = _DeterministicPolicy(policy, keys, by)
    example = tuple(th.zeros((2, *p.shape), dtype=getattr(th, p.dtype)) for p in inputs)
    names = [port.name for port in inputs]
    file = io.BytesIO()
    with _quiet():
        try:
            # The tracing exporter: torch.export fails at the checks in torch's distributions.
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


class _DeterministicPolicy(th.nn.Module):
    """
    :param policy: of Stable-Baselines3
    :param by: normalisation of its observations
    """

    def __init__(self, policy: Any, keys: Sequence[str], by: Mapping[str, Normalization]) -> None:
        super().__init__()
        self.policy, self.keys, self.by = policy, keys, by
        self.space = policy.action_space

    def forward(self, *inputs: th.Tensor) -> th.Tensor:
        """:return: actions in the units of the action space"""
        seen = {key: self._normalized(key, x) for key, x in zip(self.keys, inputs, strict=True)}
        action = self.policy._predict(seen.get(SINGLE, seen), deterministic=True).reshape(
            -1, *self.space.shape
        )
        if not isinstance(self.space, spaces.Box):
            return action
        low, high = th.as_tensor(self.space.low), th.as_tensor(self.space.high)
        if self.policy.squash_output:
            action = low + 0.5 * (action + 1.0) * (high - low)
        return th.clamp(action, low, high)

    def _normalized(self, key: str, values: th.Tensor) -> th.Tensor:
        by = self.by.get(key)
        if by is None:
            return values
        mean, scale = (th.as_tensor(part, dtype=values.dtype) for part in (by.mean, by.scale))
        return th.clamp((values - mean) / scale, -by.clip, by.clip)


def _missing(name: str) -> ImportError:
    return ImportError(f"Exporting policies needs {name}: pip install 'sb3-hds[onnx]'.")


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence the output and warnings of the converters, on which users cannot act."""
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
    Evaluate a traced function by operations that are exact in the file: jax2onnx 0.17
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
    """Refine single precision by one step of Newton's method, whose error is cubic."""
    estimate = jnp.arctan2(y.astype(jnp.float32), x.astype(jnp.float32)).astype(jnp.float64)
    radius = jnp.sqrt(x * x + y * y)
    error = (y * jnp.cos(estimate) - x * jnp.sin(estimate)) / jnp.where(radius > 0.0, radius, 1.0)
    return estimate + error
