"""Who imports whom, read from the source and drawn."""

import ast
import sys
import textwrap
from collections.abc import Iterator, Mapping
from html import escape
from pathlib import Path
from typing import NamedTuple

from tables import table

ROOT = Path(__file__).parent.parent.parent

Imports = Mapping[str, frozenset[str]]

# Of the drawing, in its own units.
_WIDTH, _BOX, _HEIGHT, _PITCH, _MARGIN = 720, 168, 80, 124, 8
_CORNER = 24  # from the corner of a box to the outermost end of an arrow
_LETTERS = 29  # that fit into a line of a box


class Layer(NamedTuple):
    """
    :param summary: first line of its docstring
    :param layers: the layers that it imports
    :param libraries: what it imports from outside, the standard library apart
    """

    summary: str
    layers: frozenset[str]
    libraries: frozenset[str]


def read(root: Path = ROOT) -> dict[str, Layer]:
    """
    :param root: of the checkout
    :return: every layer that has code, by its name; the root of the package is ``sb3_hds``
    """
    files: dict[str, list[Path]] = {}
    for path in sorted([*root.glob("sb3_hds/**/*.py"), *root.glob("rl_zoo_plugin/**/*.py")]):
        files.setdefault(_layer_of(path.relative_to(root)), []).append(path)
    return {name: _read_layer(name, paths, set(files)) for name, paths in files.items()}


def without_detours(imports: Imports) -> dict[str, frozenset[str]]:
    """
    :param imports: who imports whom, without circles
    :return: only the imports that no longer way along others stands for
    """
    return {
        layer: frozenset(t for t in targets if not _reachable(imports, targets - {t}, t))
        for layer, targets in imports.items()
    }


def ranks(imports: Imports) -> dict[str, int]:
    """:return: for each layer the longest way down from it, 0 where it imports nothing"""

    def rank(layer: str) -> int:
        return max((1 + rank(below) for below in imports[layer]), default=0)

    return {layer: rank(layer) for layer in imports}


def as_svg(layers: Mapping[str, Layer]) -> str:
    """:return: a drawing in which every arrow points down, from who imports to who is imported"""
    imports = {name: layer.layers for name, layer in layers.items()}
    places = _places(imports)
    height = max(y for _, y in places.values()) + _HEIGHT + _MARGIN
    arrows = [
        _arrow(places[layer], places[below])
        for layer, targets in without_detours(imports).items()
        for below in sorted(targets)
    ]
    boxes = [_box(name, layer.summary, *places[name]) for name, layer in layers.items()]
    head = (
        '<defs><marker id="head" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" '
        'markerHeight="7" orient="auto"><path d="M 0 0 L 10 5 L 0 10 z" fill="currentColor"/>'
        "</marker></defs>"
    )
    return (
        f'<svg viewBox="0 0 {_WIDTH} {height}" role="img" '
        'aria-label="Layers of the package; arrows point from who imports to who is imported">'
        f"{head}{''.join(arrows)}{''.join(boxes)}</svg>"
    )


def as_markdown() -> str:
    """:return: the picture, and the table of all imports"""
    layers = read()
    order = ranks({name: layer.layers for name, layer in layers.items()})
    rows = [
        [
            f"`{name}`",
            ", ".join(f"`{below}`" for below in sorted(layers[name].layers, key=order.__getitem__)),
            ", ".join(f"`{library}`" for library in sorted(layers[name].libraries)),
        ]
        for name in sorted(layers, key=lambda name: (order[name], name))
    ]
    columns = ["layer", "imports the layers", "imports from outside"]
    return f'<figure class="imports">{as_svg(layers)}</figure>\n\n{table(columns, rows)}'


def _layer_of(path: Path) -> str:
    if path.parts[0] != "sb3_hds":
        return path.parts[0]
    name = path.parts[1].removesuffix(".py")
    return "sb3_hds" if name == "__init__" else name


def _read_layer(name: str, paths: list[Path], known: set[str]) -> Layer:
    trees = {path: ast.parse(path.read_text()) for path in paths}
    modules = {module for tree in trees.values() for module in _modules(tree)}
    layers = {layer for module in modules if (layer := _layer_named(module, known))}
    tops = {module.split(".")[0] for module in modules}
    libraries = tops - known - set(sys.stdlib_module_names) - {"sb3_hds"}
    root = min(paths, key=lambda path: (path.name != "__init__.py", len(path.parts)))
    summary = (ast.get_docstring(trees[root]) or "").partition("\n\n")[0].replace("\n", " ")
    return Layer(summary.replace("`", ""), frozenset(layers - {name}), frozenset(libraries))


def _modules(tree: ast.AST) -> Iterator[str]:
    """Every module that is imported, also inside functions and for the sake of types."""
    for node in ast.walk(tree):
        match node:
            case ast.Import(names=names):
                yield from (alias.name for alias in names)
            case ast.ImportFrom(module="sb3_hds", names=names):
                yield from (f"sb3_hds.{alias.name}" for alias in names)
            case ast.ImportFrom(module=str(module)):
                yield module


def _layer_named(module: str, known: set[str]) -> str | None:
    """The layer that a module is of; a public name of the root is the root."""
    top, _, rest = module.partition(".")
    if top != "sb3_hds":
        return top if top in known else None
    layer = rest.split(".")[0]
    return layer if layer in known else "sb3_hds"


def _reachable(imports: Imports, starts: frozenset[str], target: str) -> bool:
    return any(
        target in imports[layer] or _reachable(imports, imports[layer], target) for layer in starts
    )


def _places(imports: Imports) -> dict[str, tuple[float, float]]:
    """Upper left corners: rows by rank, in the middle what the row above imports."""
    order, near = ranks(imports), without_detours(imports)
    top = max(order.values())
    places = {}
    for rank in range(top + 1):
        row = sorted(layer for layer in order if order[layer] == rank)
        above = {t for layer in near if order[layer] == rank + 1 for t in near[layer]}
        row.sort(key=lambda layer: layer in above)
        # The last ones, imported from the row above, go to the middle.
        middle = row[: len(row) // 2] + row[len(row) // 2 :][::-1]
        for i, layer in enumerate(middle):
            x = _WIDTH * (i + 0.5) / len(row) - _BOX / 2
            places[layer] = (x, _MARGIN + (top - rank) * _PITCH)
    return places


def _arrow(start: tuple[float, float], end: tuple[float, float]) -> str:
    (x1, y1), (x2, y2) = ((x + _BOX / 2, y) for x, y in (start, end))
    reach = _BOX / 2 - _CORNER
    leave, arrive = x1 + max(-reach, min(reach, x2 - x1)), x2 + max(-reach, min(reach, x1 - x2)) / 4
    y1 += _HEIGHT
    bend = (y1 + y2) / 2
    return (
        f'<path d="M {leave:.0f} {y1:.0f} C {arrive:.0f} {y1 + _CORNER:.0f}, '
        f'{arrive:.0f} {bend:.0f}, {arrive:.0f} {y2:.0f}" fill="none" stroke="currentColor" '
        'stroke-width="1.3" marker-end="url(#head)"/>'
    )


def _box(name: str, summary: str, x: float, y: float) -> str:
    lines = textwrap.wrap(summary.partition(":")[0].rstrip("."), _LETTERS)
    text = "".join(
        f'<text x="{x + _BOX / 2:.0f}" y="{y + 32 + 12 * i:.0f}" font-size="10.5" '
        f'text-anchor="middle" fill="currentColor">{escape(line)}</text>'
        for i, line in enumerate(lines)
    )
    return (
        f'<rect x="{x:.0f}" y="{y:.0f}" width="{_BOX}" height="{_HEIGHT}" rx="6" '
        'fill="var(--color-background-secondary, white)" stroke="currentColor"/>'
        f'<text x="{x + _BOX / 2:.0f}" y="{y + 18:.0f}" font-size="14" font-weight="bold" '
        f'text-anchor="middle" fill="currentColor">{escape(name)}</text>{text}'
    )
