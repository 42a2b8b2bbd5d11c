"""How types, expressions, loops and constants are written in C."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from sb3_hds.errors import ExportError

KINDS = {
    "float32": "float",
    "float64": "double",
    "int64": "long long",
    "int32": "int",
    "bool": "unsigned char",
}
# Elementwise operations; {f}: suffix of functions in single precision.
EXPRESSIONS: dict[str, str] = {
    "Abs": "fabs{f}({0})",
    "Add": "{0} + {1}",
    "And": "{0} && {1}",
    "Atan": "atan{f}({0})",
    "Ceil": "ceil{f}({0})",
    "Cos": "cos{f}({0})",
    "Div": "{0} / {1}",
    "Equal": "{0} == {1}",
    "Erf": "erf{f}({0})",
    "Exp": "exp{f}({0})",
    "Floor": "floor{f}({0})",
    "Greater": "{0} > {1}",
    "GreaterOrEqual": "{0} >= {1}",
    "Less": "{0} < {1}",
    "LessOrEqual": "{0} <= {1}",
    "Log": "log{f}({0})",
    "Mul": "{0} * {1}",
    "Neg": "-{0}",
    "Not": "!{0}",
    "Or": "{0} || {1}",
    "Pow": "pow{f}({0}, {1})",
    "Reciprocal": "1 / {0}",
    "Relu": "{0} > 0 ? {0} : 0",
    "Sigmoid": "1 / (1 + exp{f}(-{0}))",
    "Sign": "({0} > 0) - ({0} < 0)",
    "Sin": "sin{f}({0})",
    "Softplus": "{0} > 0 ? {0} + log1p{f}(exp{f}(-{0})) : log1p{f}(exp{f}({0}))",
    "Softsign": "{0} / (1 + fabs{f}({0}))",
    "Sqrt": "sqrt{f}({0})",
    "Sub": "{0} - {1}",
    "Tanh": "tanh{f}({0})",
    "Where": "{0} ? {1} : {2}",
}
# Operations on any number of inputs, as an expression of two.
FOLDED = {"Max": "{0} > {1} ? {0} : {1}", "Min": "{0} < {1} ? {0} : {1}"}
REDUCED = {
    "ReduceMax": ("{x}[0]", "total = {v} > total ? {v} : total;", "total"),
    "ReduceMean": ("0", "total += {v};", "total / {n}"),
    "ReduceMin": ("{x}[0]", "total = {v} < total ? {v} : total;", "total"),
    "ReduceSum": ("0", "total += {v};", "total"),
    "ReduceSumSquare": ("0", "total += {v} * {v};", "total"),
}
# Weights per line of the header.
_PER_LINE = 8


def activation(kind: str, attributes: Mapping[str, Any]) -> str:
    alpha = f"{attributes.get('alpha', {'LeakyRelu': 0.01, 'HardSigmoid': 0.2}.get(kind, 1.0))!r}"
    return {
        "Elu": f"{{0}} > 0 ? {{0}} : {alpha} * expm1{{f}}({{0}})",
        "Celu": f"{{0}} > 0 ? {{0}} : {alpha} * expm1{{f}}({{0}} / {alpha})",
        "LeakyRelu": f"{{0}} > 0 ? {{0}} : {alpha} * {{0}}",
        "Selu": f"{attributes.get('gamma', 1.0507009873554805)!r} * ({{0}} > 0 ? {{0}} : "
        f"{attributes.get('alpha', 1.6732632423543772)!r} * expm1{{f}}({{0}}))",
        "HardSigmoid": f"{alpha} * {{0}} + {attributes.get('beta', 0.5)!r} < 0 ? 0 : ({alpha} * "
        f"{{0}} + {attributes.get('beta', 0.5)!r} > 1 ? 1 : {alpha} * {{0}} + "
        f"{attributes.get('beta', 0.5)!r})",
        "Gelu": "0.5f * {0} * (1 + erf{f}({0} * 0.70710678118654752f))"
        if attributes.get("approximate", "none") == "none"
        else "0.5f * {0} * (1 + tanh{f}(0.79788456080286536f * {0} * (1 + 0.044715f * {0} * {0})))",
    }[kind]


def place_of(labels: str, shape: tuple[int, ...]) -> str:
    """Offset of an element of an array, in terms of the indices of its axes."""
    parts, stride = [], 1
    for label, n in zip(reversed(labels), reversed(shape), strict=True):
        if n > 1:
            parts.append(f"n_{label}" if stride == 1 else f"{stride} * n_{label}")
        stride *= n
    return " + ".join(reversed(parts)) or "0"


def loop_over(label: str, n: int) -> str:
    return f"for (int n_{label} = 0; n_{label} < {n}; ++n_{label}) "


def array_of(kind: str, symbol: str, values: np.ndarray) -> list[str]:
    write: Callable[[Any], str] = {
        "float": lambda x: _literal(float(x), 9, "f"),
        "double": lambda x: _literal(float(x), 17, ""),
    }.get(kind, lambda x: str(int(x)))
    numbers = list(map(write, values.ravel()))
    rows = [numbers[i : i + _PER_LINE] for i in range(0, len(numbers), _PER_LINE)]
    return [
        f"static const {kind} {symbol}[{len(numbers)}] = {{",
        *(f"    {', '.join(row)}," for row in rows),
        "};",
    ]


def _literal(x: float, digits: int, suffix: str) -> str:
    """:raises ExportError: for a weight that is NaN"""
    if np.isinf(x):
        return f"{'-' if x < 0 else ''}HUGE_VAL{suffix.upper()}"
    if np.isnan(x):
        raise ExportError("A weight of the policy is not a number.")
    text = f"{x:.{digits}g}"
    return f"{text if any(c in text for c in '.e') else f'{text}.0'}{suffix}"


def layer_norm(
    kind: str,
    shape: tuple[int, int],
    names: tuple[str, str],
    weights: Sequence[str],
    epsilon: float,
) -> str:
    """
    :param kind: C type
    :param shape: rows, and numbers in each
    :param names: of the input row, and of the output row
    :param weights: scale, and shift where there is one
    """
    (rows, n), (x, y) = shape, names
    root = "sqrtf" if kind == "float" else "sqrt"
    scaled = " + ".join([f"({x}[k] - mean) * scale * {weights[0]}", *weights[1:]])
    return (
        f"for (j = 0; j < {rows}; ++j) {{ {kind} mean = 0, scale = 0; "
        f"for (k = 0; k < {n}; ++k) mean += {x}[k]; mean /= {n}; "
        f"for (k = 0; k < {n}; ++k) scale += ({x}[k] - mean) * ({x}[k] - mean); "
        f"scale = 1 / {root}(scale / {n} + ({kind}){epsilon!r}); "
        f"for (k = 0; k < {n}; ++k) {y}[k] = {scaled}; }}"
    )


def over_last(operation: str, kind: str, shape: tuple[int, int], names: tuple[str, str]) -> str:
    """
    :param operation: ``"ArgMax"``, ``"Softmax"`` or ``"ReduceLogSumExp"``
    :param kind: C type
    :param shape: rows, and numbers in each
    :param names: of the input row, and of the output array
    """
    (rows, n), (x, y) = shape, names
    f = "f" if kind == "float" else ""
    most = f"{kind} most = {x}[0], total = 0; "
    most += f"for (k = 1; k < {n}; ++k) most = {x}[k] > most ? {x}[k] : most; "
    summed = f"for (k = 0; k < {n}; ++k) total += exp{f}({x}[k] - most); "
    if operation == "ArgMax":
        inside = f"{y}[j] = 0; for (k = 1; k < {n}; ++k) if ({x}[k] > {x}[{y}[j]]) {y}[j] = k; "
    elif operation == "Softmax":
        write = f"for (k = 0; k < {n}; ++k) {y}[j * {n} + k] = exp{f}({x}[k] - most) / total; "
        inside = most + summed + write
    else:
        inside = f"{most}{summed}{y}[j] = most + log{f}(total); "
    return f"for (j = 0; j < {rows}; ++j) {{ {inside}}}"
