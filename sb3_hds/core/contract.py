"""
Checks of a user's twin before use: its declarations, and shapes and dtypes of what it returns.
"""

import inspect
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from sb3_hds.core.analytic import AnalyticTwin
from sb3_hds.core.declarations import Actuator, Channel, Joint
from sb3_hds.core.twin import State, Twin, layers_of
from sb3_hds.errors import TwinError

_SIGNALS = {"joints": Joint, "actuators": Actuator, "channels": Channel}
_MAX_MESSAGE = 200  # characters of another library's message
_MAX_NAMES = 4
_REMEDIES = {
    "TracerBoolConversionError": "Replace `if` on an array by jnp.where.",
    "ConcretizationTypeError": "Replace `if` and float() on an array by jnp.where and jnp.",
    "TracerArrayConversionError": "Use jax.numpy instead of numpy and math.",
}


def check_methods(twin: Twin) -> None:
    """
    Check the declarations of a twin, and type, shape and dtype of what each of its methods returns.

    Methods are evaluated abstractly (``jax.eval_shape``), in single and in double precision:
    nothing is computed or compiled. Equal twins are checked once. Twins of the library are covered
    by its tests and skipped.

    :raises TwinError: in one line, with the method, the expected and the actual return value
    """
    try:
        hash(twin)
    except TypeError as error:
        raise TwinError(
            f"The options of {type(twin).__name__} must be hashable, because equal twins share a "
            f"compiled program: {error}. Use tuples instead of lists."
        ) from None
    for layer in reversed(list(layers_of(twin))):
        if not _is_from_library(layer):
            check_layer(layer)


def _is_from_library(layer: Twin) -> bool:
    """Whether the layer, its effects and its transforms are all classes of this package."""
    transforms = (getattr(layer, name, None) for name in ("observation", "action", "stateful"))
    parts = (layer, *getattr(layer, "effects", ()), *filter(None, transforms))
    return all(type(part).__module__.partition(".")[0] == "sb3_hds" for part in parts)


@lru_cache(maxsize=256)
def check_layer(twin: Twin) -> None:
    """
    :func:`check_methods` for a single layer of a twin, from the library or not.

    :raises TwinError: as there
    """
    _check_declarations(twin)
    for double in (False, True):
        with jax.enable_x64(double):
            _check_returns(twin, jnp.float64 if double else jnp.float32)


def _check_declarations(twin: Twin) -> None:
    kind = type(twin).__name__
    for name, signal in _SIGNALS.items():
        declared = getattr(twin, name, None)
        form = f"{name} = ({signal.__name__}(...),)"
        if not isinstance(declared, Sequence) or any(
            not isinstance(one, signal) for one in declared
        ):
            raise TwinError(
                f"{kind} must declare {name} as a tuple of {signal.__name__}, got {declared!r}. "
                f"Write {form}, with a comma even after a single one."
            )
        counts = Counter(signal.name for signal in declared)
        if repeated := [one for one, n in counts.items() if n > 1]:
            raise TwinError(
                f"{kind} has {name} of the same name: {', '.join(repeated)}. Rename one."
            )
    for signal in (*twin.actuators, *twin.channels):
        if not signal.low < signal.high:
            raise TwinError(
                f"The limits of '{signal.name}' in {kind} must be low < high, got {signal.low} and "
                f"{signal.high}."
            )
    for place, targets in twin.native_effects.items():
        unknown = set(targets.values()) - set(twin.parameters)
        if unknown:
            raise TwinError(
                f"native_effects of {kind} maps {place} to {', '.join(sorted(unknown))}, which is "
                f"no parameter. Its parameters are: {', '.join(twin.parameters) or 'none'}."
            )


def _check_returns(twin: Twin, dtype: Any) -> None:
    """:param dtype: of all arguments, and therefore of all return values"""

    def array(*shape: int) -> Any:
        return jax.ShapeDtypeStruct(shape, dtype)

    def in_dtype(leaf: Any) -> jax.ShapeDtypeStruct:
        like = jnp.result_type(leaf)
        kept = like if not jnp.issubdtype(like, jnp.floating) else dtype
        return jax.ShapeDtypeStruct(getattr(leaf, "shape", ()), kept)

    dof = len(twin.joints)
    joints, channels = _listed("joint", twin.joints), _listed("channel", twin.channels)
    per_joint = f"one entry for each {joints}"
    params = jax.tree.map(in_dtype, twin.params)
    key = jax.eval_shape(lambda: jax.random.key(0))
    call = _Caller(twin, dtype)

    state = call("initial", key, params)
    n_q = _n_positions(twin, state, dof)
    call.expect_state("initial", state, dof, per_joint, n_q, any_float=True)
    state = State(array(n_q), array(dof), jax.tree.map(in_dtype, state.memory))
    obs, action = array(len(twin.channels)), array(len(twin.actuators))

    inferred = call("infer", obs, params)
    call.expect_state("infer", inferred, dof, per_joint, n_q)
    seen = call("observe", state, params)
    call.expect("observe", seen, obs, f"one entry for each {channels}")
    if isinstance(twin, AnalyticTwin):
        q, v = state.q, state.v
        force = f"one generalised force for each {joints}, zero where nothing pushes"
        call.expect("actuate", call("actuate", state, action, params), v, force)
        square = f"a row and a column for each {joints}"
        call.expect("mass_matrix", call("mass_matrix", q, params), array(dof, dof), square)
        call.expect("bias", call("bias", q, v, params), v, force)
        call.expect("coordinates", call("coordinates", q), v, per_joint)
        call.expect("limit_velocity", call("limit_velocity", v), v, per_joint)
        limited = call("limit", q, v)
        if not (isinstance(limited, tuple) and len(limited) == 2):
            call.refuse("limit", _described(limited), "the pair (q, v)")
        for part, like in zip(limited, (q, v), strict=True):
            call.expect("limit", part, like, per_joint)
    after = call("step", state, action, params)
    call.expect_state("step", after, dof, per_joint, n_q, memory=state.memory)
    number = "one number; over joints, take jnp.sum(...) or an entry"
    for method in ("reward", "planning_reward"):
        call.expect(method, call(method, state, action, state, params), array(), number)
    over = jax.ShapeDtypeStruct((), jnp.bool_)
    truth = "one truth value; over joints, take jnp.any(...)"
    call.expect("terminated", call("terminated", state, params), over, truth)
    tangent = call("difference", state, state)
    if getattr(tangent, "ndim", None) != 1:
        call.refuse("difference", _described(tangent), "a vector")
    call.expect("difference", tangent, tangent, "a vector")
    moved = call("retract", state, tangent)
    call.expect_state("retract", moved, dof, per_joint, n_q, memory=state.memory)
    points = call("sketch", state, params)
    if getattr(points, "shape", ())[1:] != (2,):
        call.refuse("sketch", _described(points), "shape (points, 2): two coordinates of each")


def _n_positions(twin: Twin, state: Any, dof: int) -> int:
    """
    Length of a position: one number for each joint, or that of the state if ``difference`` accepts
    it, as with quaternions.
    """
    shape = getattr(getattr(state, "q", None), "shape", None)
    if not isinstance(state, State) or not shape or len(shape) != 1 or shape[0] <= dof:
        return dof
    try:
        own = state._replace(memory={})
        return shape[0] if jax.eval_shape(twin.difference, own, own).shape == (2 * dof,) else dof
    except Exception:  # reported by the caller
        return dof


class _Caller:
    """Evaluates methods of a twin abstractly; errors say in one line what is wrong."""

    def __init__(self, twin: Twin, dtype: Any) -> None:
        self.twin, self.dtype = twin, jnp.dtype(dtype)

    def __call__(self, method: str, *arguments: Any) -> Any:
        function = getattr(self.twin, method)
        try:
            return jax.eval_shape(function, *arguments)
        except TwinError:
            raise
        except Exception as error:
            raise TwinError(self._failure(method, function, error)) from error

    def expect(self, method: str, found: Any, like: Any, meaning: str) -> None:
        """:param meaning: what the shape means, in words"""
        if not isinstance(found, jax.ShapeDtypeStruct):
            self.refuse(method, _described(found), f"one array of shape {like.shape}: {meaning}")
        if found.shape != like.shape:
            self.refuse(method, f"shape {found.shape}", f"{like.shape}: {meaning}")
        if found.dtype != like.dtype:
            self.refuse(method, str(found.dtype), f"{like.dtype}. {self._cast(found, like)}")

    def expect_state(
        self,
        method: str,
        found: Any,
        dof: int,
        meaning: str,
        n_q: int,
        *,
        memory: Any = None,
        any_float: bool = False,
    ) -> None:
        """
        :param n_q: length of a position
        :param memory: whose shapes and dtypes the state's memory must have; None: any
        :param any_float: whether another precision is accepted
        """
        if not isinstance(found, State):
            self.refuse(method, _described(found), "State(q, v, memory)")
        for part, size in (("q", n_q), ("v", dof)):
            entry = getattr(found, part)
            other = any_float and jnp.issubdtype(getattr(entry, "dtype", int), jnp.floating)
            like = jax.ShapeDtypeStruct((size,), entry.dtype if other else self.dtype)
            self.expect(f"{method}(...).{part}", entry, like, meaning)
        if not isinstance(found.memory, dict):
            self.refuse(
                f"{method}(...).memory", _described(found.memory), "a dictionary, {} where nothing "
                "is remembered"
            )  # fmt: skip
        if memory is not None and _summary(found.memory) != _summary(memory):
            self.refuse(
                f"{method}(...).memory", str(_summary(found.memory)), f"{_summary(memory)}, as it "
                "went in. Pass state.memory on"
            )  # fmt: skip

    def refuse(self, method: str, found: str, expected: str) -> None:
        raise TwinError(
            f"{type(self.twin).__name__}.{method} returns {found}, expected {expected}."
        )

    def _failure(self, method: str, function: Callable[..., Any], error: Exception) -> str:
        message = " ".join(str(error).split())
        message = message if len(message) <= _MAX_MESSAGE else f"{message[:_MAX_MESSAGE]}..."
        names = [base.__name__ for base in type(error).__mro__]
        remedy = next((f" {_REMEDIES[name]}" for name in names if name in _REMEDIES), "")
        if isinstance(error, KeyError):
            remedy = f" Its parameters are: {', '.join(self.twin.params) or 'none'}."
        return (
            f"{type(self.twin).__name__}.{method} raises {type(error).__name__}"
            f"{_line_of(function, error)}: {message}.{remedy}"
        )

    def _cast(self, found: Any, like: Any) -> str:
        if like.dtype == jnp.bool_:
            return "Compare, as in jnp.abs(state.q[0]) > 1.0"
        if not jnp.issubdtype(found.dtype, jnp.floating):
            return "Write constants with a decimal point, and 1.0 * (...) around comparisons"
        return (
            "Data are fitted in double precision and policies trained in single: make arrays with "
            "the dtype of what comes in, as in jnp.zeros(3, q.dtype)"
        )


def _listed(what: str, signals: Sequence[Any]) -> str:
    """``"joint (hip, knee)"``, with the first few names."""
    names = [signal.name for signal in signals]
    shown = [*names[:_MAX_NAMES], *(["..."] if len(names) > _MAX_NAMES else [])]
    return f"{what} ({', '.join(shown) or 'none'})"


def _described(found: Any) -> str:
    if isinstance(found, jax.ShapeDtypeStruct):
        return f"one array of shape {found.shape}"
    return "None" if found is None else f"a {type(found).__name__}"


def _summary(tree: Any) -> Any:
    """The same tree with shapes and dtypes instead of arrays."""
    return jax.tree.map(lambda leaf: f"{leaf.dtype}{list(leaf.shape)}", tree)


def _line_of(function: Callable[..., Any], error: Exception) -> str:
    """The line of the method that raised: `` (rigs.py, line 42)``."""
    file = inspect.unwrap(function).__code__.co_filename if inspect.ismethod(function) else ""
    lines: Iterator[int | None] = (
        frame.lineno
        for frame in reversed(traceback.extract_tb(error.__traceback__))
        if frame.filename == file
    )
    line = next(lines, None)
    return f" ({Path(file).name}, line {line})" if line else ""
