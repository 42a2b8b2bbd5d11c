"""ONNX operations as C statements, for a batch of one and known shapes."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from sb3_hds.deploy.c_text import (
    EXPRESSIONS,
    FOLDED,
    KINDS,
    REDUCED,
    activation,
    array_of,
    layer_norm,
    loop_over,
    over_last,
    place_of,
)
from sb3_hds.errors import ExportError

# Operations that only move numbers: applied to indices, they show which number goes where.
_MOVES = {
    "Concat",
    "Expand",
    "Flatten",
    "Gather",
    "Identity",
    "Reshape",
    "Slice",
    "Split",
    "Squeeze",
    "Transpose",
    "Unsqueeze",
}


class Translation:
    """
    The C code of an ONNX model.

    :param proto: an ``onnx.ModelProto``
    :param shapes: of its inputs, with a leading axis of one
    :raises ExportError: for an operation without a translation
    """

    def __init__(self, proto: Any, shapes: Mapping[str, tuple[int, ...]]) -> None:
        from onnx import helper, numpy_helper
        from onnx.reference import ReferenceEvaluator

        self._opset = list(proto.opset_import)
        graph = proto.graph
        weights = {part.name: numpy_helper.to_array(part) for part in graph.initializer}
        zeros = {
            port.name: np.zeros(
                shapes[port.name], helper.tensor_dtype_to_np_dtype(port.type.tensor_type.elem_type)
            )
            for port in graph.input
        }
        with np.errstate(all="ignore"):
            values = ReferenceEvaluator(proto).run(None, zeros, intermediate=True)
        found: dict[str, Any] = {**weights, **zeros, **values}  # type: ignore[dict-item]
        self._values = {name: np.asarray(value) for name, value in found.items() if name}
        self._constant = set(weights)
        self.inputs = list(zeros)
        self.outputs = {port.name: port.name for port in graph.output}
        self._symbols: dict[str, str] = {}
        self._alias: dict[str, str] = {}
        self._used: dict[str, None] = {}
        self._tables: dict[str, np.ndarray] = {}
        self._buffers: dict[str, None] = {}
        self._statements: list[str] = []
        self.n_operations = 0
        for node in graph.node:
            if node.op_type == "Shape" or self._constant.issuperset(filter(None, node.input)):
                self._constant |= set(node.output)
        for node in self._needed(graph):
            self._translate(node)

    # --- parts of the header

    def kind(self, name: str) -> str:
        """:return: the C type of an array"""
        return KINDS[self._values[name].dtype.name]

    def size(self, name: str) -> int:
        """:return: its number of elements"""
        return int(self._values[name].size)

    def symbol(self, name: str) -> str:
        """:return: its name in C"""
        name = self._alias.get(name, name)
        if name in self.inputs:
            return re.sub(r"\W", "_", name, flags=re.ASCII)
        return self._symbols.setdefault(name, f"v{len(self._symbols)}")

    def declared(self, name: str, symbol: str | None = None) -> str:
        """:return: its declaration in C; default: by its own symbol"""
        return f"{self.kind(name)} {symbol or self.symbol(name)}[{self.size(name)}];"

    @property
    def constant_bytes(self) -> int:
        """Size of weights and tables."""
        weights = sum(self._values[name].nbytes for name in self._used)
        return int(weights + 4 * sum(table.size for table in self._tables.values()))

    @property
    def stack_bytes(self) -> int:
        """Size of all buffers of a call."""
        return int(sum(self._values[name].nbytes for name in self._buffers))

    def constants(self, prefix: str) -> list[str]:
        """:return: their declarations, in the namespace of ``prefix``"""
        lines = []
        for name in self._used:
            lines += array_of(self.kind(name), f"{prefix}_{self.symbol(name)}", self._values[name])
        for symbol, table in self._tables.items():
            lines += array_of("int", f"{prefix}_{symbol}", table)
        return lines

    def body(self, prefix: str) -> list[str]:
        """:return: the statements of a call"""
        declared = map(self.declared, self._buffers)
        statements = [re.sub(r"@(\w+)@", rf"{prefix}_\1", line) for line in self._statements]
        idle = [f"(void){name};" for name in ("i", "j", "k", *map(self.symbol, self.inputs))]
        return ["int i = 0, j = 0, k = 0;", *declared, *idle, *statements]

    def copied(self, name: str, target: str) -> list[str]:
        """:return: statements that copy an array"""
        return [f"for (i = 0; i < {self.size(name)}; ++i) {target}[i] = {self._read(name)}[i];"]

    # --- translation of single operations

    def _needed(self, graph: Any) -> list[Any]:
        """The operations that the outputs depend on, in order, without those on constants."""
        wanted, found = {port.name for port in graph.output}, []
        for node in reversed(graph.node):
            if wanted & set(node.output) - self._constant:
                wanted |= set(node.input)
                found.append(node)
        return found[::-1]

    def _translate(self, node: Any) -> None:
        inputs = [name for name in node.input if name]
        kind = node.op_type
        attributes = _attributes_of(node)
        if not any(map(self.size, node.output)):
            return
        if kind in _MOVES:
            self._move(node, inputs)
        elif kind == "Cast":
            to_bool = self._values[node.output[0]].dtype == np.bool_
            self._elementwise(node.output[0], "{0} != 0" if to_bool else "{0}", inputs)
        elif kind in EXPRESSIONS:
            self._elementwise(node.output[0], EXPRESSIONS[kind], inputs)
        elif kind in FOLDED:
            others = [(name, FOLDED[kind]) for name in inputs[1:]]
            self._folded(node.output[0], inputs[0], others)
        elif kind == "Clip":
            ends = zip(node.input[1:], (FOLDED["Max"], FOLDED["Min"]), strict=False)
            self._folded(node.output[0], node.input[0], [end for end in ends if end[0]])
        elif kind in ("Elu", "LeakyRelu", "Selu", "Celu", "HardSigmoid", "Gelu"):
            self._elementwise(node.output[0], activation(kind, attributes), inputs)
        elif kind in ("Gemm", "MatMul", "Einsum"):
            self._product(node, inputs, attributes)
        elif kind in REDUCED:
            self._reduce(node, inputs)
        elif kind == "LayerNormalization":
            self._layer_norm(node, inputs, attributes)
        elif kind in ("ReduceLogSumExp", "Softmax", "ArgMax"):
            self._over_last(node, inputs)
        else:
            raise ExportError(
                f"The operation {kind} of ONNX has no translation to C. Run the ONNX file "
                "itself, or use another activation function."
            )

    def _read(self, name: str) -> str:
        """The symbol of a constant or a buffer."""
        name = self._alias.get(name, name)
        if name in self._constant:
            self._used[name] = None
            return f"@{self.symbol(name)}@"
        return self.symbol(name)

    def _new(self, name: str) -> str:
        self._buffers[name] = None
        return self.symbol(name)

    def _index(self, shape: tuple[int, ...], name: str, index: str = "i") -> str:
        """Index into an input for element ``index`` of the result, under broadcasting."""
        value = self._values[name]
        places = np.arange(value.size).reshape(value.shape)
        table = np.broadcast_to(places, shape).ravel()
        if value.size == 1:
            return "0"
        if np.array_equal(table, np.arange(table.size)):
            return index
        if np.array_equal(table, np.arange(table.size) % value.size):
            return f"{index} % {value.size}"
        return f"{self._table(table)}[{index}]"

    def _table(self, table: np.ndarray) -> str:
        for symbol, known in self._tables.items():
            if np.array_equal(known, table):
                return f"@{symbol}@"
        symbol = f"t{len(self._tables)}"
        self._tables[symbol] = table
        return f"@{symbol}@"

    def _at(self, shape: tuple[int, ...], name: str) -> str:
        return f"{self._read(name)}[{self._index(shape, name)}]"

    def _elementwise(self, output: str, expression: str, inputs: Sequence[str]) -> None:
        shape = self._values[output].shape
        single = all(self._values[name].dtype != np.float64 for name in inputs)
        read = [self._at(shape, name) for name in inputs]
        self._loop(output, expression.format(*read, f="f" if single else ""))

    def _loop(self, output: str, text: str) -> None:
        n = self.size(output)
        kind = self.kind(output)
        self.n_operations += n
        self._statements.append(
            f"for (i = 0; i < {n}; ++i) {self._new(output)}[i] = ({kind})({text});"
        )

    def _folded(self, output: str, first: str, others: Iterable[tuple[str, str]]) -> None:
        """:param others: inputs, and the expression that combines each with the result so far"""
        shape = self._values[output].shape
        text = self._at(shape, first)
        for name, expression in others:
            text = f"({expression.format(text, self._at(shape, name))})"
        self._loop(output, text)

    def _move(self, node: Any, inputs: Sequence[str]) -> None:
        data = inputs if node.op_type == "Concat" else inputs[:1]
        if any(name not in self._constant for name in inputs if name not in data):
            raise ExportError(f"{node.op_type} by a computed index has no translation to C.")
        first, given = 0, []
        for name in inputs:
            value = self._values[name]
            if name in data:
                given.append((first + np.arange(value.size)).reshape(value.shape))
                first += value.size
            else:
                given.append(value)
        ends = np.cumsum([0, *(self.size(name) for name in data)])
        for output, places in zip(node.output, _evaluated(node, given, self._opset), strict=True):
            table = np.asarray(places).ravel()
            unchanged = table.size and np.array_equal(table, np.arange(ends[1]))
            if unchanged and len(data) == 1:
                self._alias[output] = self._alias.get(data[0], data[0])
                continue
            self._gather(output, table, data, ends)

    def _gather(
        self, output: str, table: np.ndarray, data: Sequence[str], ends: np.ndarray
    ) -> None:
        """Copy each run of contiguous elements in a loop."""
        target = self._new(output)
        source = np.searchsorted(ends, table, side="right") - 1
        breaks = np.flatnonzero((np.diff(table) != 1) | (np.diff(source) != 0)) + 1
        runs = np.split(np.arange(table.size), breaks) if table.size else []
        for run in runs:
            place = int(source[run[0]])
            start = int(table[run[0]] - ends[place])
            self._statements.append(
                f"for (i = 0; i < {len(run)}; ++i) "
                f"{target}[{run[0]} + i] = {self._read(data[place])}[{start} + i];"
            )

    def _product(self, node: Any, inputs: Sequence[str], attributes: Mapping[str, Any]) -> None:
        output = node.output[0]
        shapes = [self._values[name].shape for name in inputs]
        if node.op_type == "Einsum":
            equation = attributes["equation"].replace(" ", "")
        elif node.op_type == "Gemm":
            left = "ki" if attributes.get("transA") else "ik"
            equation = f"{left},{'jk' if attributes.get('transB') else 'kj'}->ij"
        else:
            left = "abcdefgh"[: len(shapes[0]) - 2] + "ik"
            right = ("abcdefgh"[: len(shapes[1]) - 2] + "kj") if len(shapes[1]) > 1 else "k"
            rest = left[:-1] + ("j" if len(shapes[1]) > 1 else "")
            equation = f"{left},{right}->{rest}"
        alpha, beta = attributes.get("alpha", 1.0), attributes.get("beta", 1.0)
        bias = inputs[2] if node.op_type == "Gemm" and len(inputs) > 2 else None
        if "." in equation or len(equation.split("->")[0].split(",")) != 2 or alpha != 1.0:
            raise ExportError(f"{node.op_type} ({equation}) has no translation to C.")
        self._contraction(output, equation, inputs[:2], bias, beta)

    def _contraction(
        self, output: str, equation: str, inputs: Sequence[str], bias: str | None, beta: float
    ) -> None:
        sides, result = equation.split("->")
        terms = sides.split(",")
        extent: dict[str, int] = {}
        for labels, name in zip(terms, inputs, strict=True):
            sizes = zip(labels, self._values[name].shape, strict=True)
            extent |= {label: n for label, n in sizes if extent.get(label, 1) == 1}
        outer = [label for label in result if extent[label] > 1]
        summed = [label for label in extent if label not in result and extent[label] > 1]
        read = []
        for labels, name in zip(terms, inputs, strict=True):
            read.append(f"{self._read(name)}[{place_of(labels, self._values[name].shape)}]")
        place = place_of(result, self._values[output].shape)
        kind, target = self.kind(output), self._new(output)
        start = "0"
        if bias is not None:
            index = self._index(self._values[output].shape, bias, "o")
            scale = "" if beta == 1.0 else f"{beta!r}f * "
            start = f"{scale}{self._read(bias)}[{index}]"
        loops = "".join(loop_over(label, extent[label]) for label in outer)
        inner = "".join(loop_over(label, extent[label]) for label in summed)
        self.n_operations += 2 * int(np.prod([extent[label] for label in outer + summed]))
        self._statements.append(
            f"{loops}{{ const int o = {place}; {kind} total = {start}; "
            f"{inner}total += {read[0]} * {read[1]}; {target}[o] = total; }}"
        )

    def _reduce(self, node: Any, inputs: Sequence[str]) -> None:
        n_outer, n = self._last(node, inputs)
        x = f"({self._read(inputs[0])} + j * {n})"
        fill = {"x": x, "v": f"{x}[k]", "n": str(n)}
        total, term, result = (text.format(**fill) for text in REDUCED[node.op_type])
        self.n_operations += n_outer * n
        self._statements.append(
            f"for (j = 0; j < {n_outer}; ++j) {{ {self.kind(node.output[0])} total = {total}; "
            f"for (k = 0; k < {n}; ++k) {term} {self._new(node.output[0])}[j] = {result}; }}"
        )

    def _last(self, node: Any, inputs: Sequence[str]) -> tuple[int, int]:
        """Number of rows and their length, for an operation over the last axes."""
        value, attributes = self._values[inputs[0]], _attributes_of(node)
        axes = attributes.get("axes", attributes.get("axis"))
        if len(inputs) > 1:
            axes = self._values[inputs[1]].ravel().tolist()
        axes = range(value.ndim) if axes is None else np.atleast_1d(axes).tolist()
        reduced = sorted(axis % value.ndim for axis in axes)
        if reduced != list(range(value.ndim - len(reduced), value.ndim)):
            raise ExportError(f"{node.op_type} over other axes than the last has no translation.")
        n = int(np.prod([value.shape[axis] for axis in reduced]))
        return value.size // n, n

    def _layer_norm(self, node: Any, inputs: Sequence[str], attributes: Mapping[str, Any]) -> None:
        value = self._values[inputs[0]]
        axis = attributes.get("axis", -1) % value.ndim
        n = int(np.prod(value.shape[axis:]))
        x, y = f"({self._read(inputs[0])} + j * {n})", f"({self._new(node.output[0])} + j * {n})"
        weights = [f"{self._read(name)}[k]" for name in inputs[1:]]
        self.n_operations += 8 * value.size
        self._statements.append(
            layer_norm(
                self.kind(inputs[0]),
                (value.size // n, n),
                (x, y),
                weights,
                attributes.get("epsilon", 1e-5),
            )
        )

    def _over_last(self, node: Any, inputs: Sequence[str]) -> None:
        kind, output = node.op_type, node.output[0]
        n_outer, n = self._last(node, inputs)
        x, y = f"({self._read(inputs[0])} + j * {n})", self._new(output)
        self.n_operations += 3 * n_outer * n
        self._statements.append(over_last(kind, self.kind(inputs[0]), (n_outer, n), (x, y)))


def _attributes_of(node: Any) -> dict[str, Any]:
    from onnx import helper

    found = {part.name: helper.get_attribute_value(part) for part in node.attribute}
    return {k: v.decode() if isinstance(v, bytes) else v for k, v in found.items()}


def _evaluated(node: Any, given: Sequence[np.ndarray], opset: Sequence[Any]) -> list[Any]:
    """What an operation does to these arrays, by ONNX's reference implementation."""
    from onnx import helper
    from onnx.reference import ReferenceEvaluator

    # Each input gets its own name, since a node may read one array twice.
    names = [f"x{i}" if name else "" for i, name in enumerate(node.input)]
    copy = type(node)()
    copy.CopyFrom(node)
    copy.input[:] = names
    used = [name for name in names if name]
    function = helper.make_function("", "one", used, node.output, [copy], opset)
    values = dict(zip(used, given, strict=True))
    return ReferenceEvaluator(function).run(None, values, {})  # type: ignore[return-value]
