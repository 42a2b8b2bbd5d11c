"""The import rule of the design: layers import to the left, and libraries where they belong."""

import ast
import sys
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

ROOT = Path(__file__).parent.parent

ORDER = (
    {"errors", "lazy"},
    {"core"},
    {"data", "twins", "effects"},
    {"planning", "sysid"},
    {"envs", "wrappers"},
    {"deploy"},
    {"algos"},
    {"experiments"},
    {"rl_zoo_plugin", "cli"},
)
ALL = set().union(*ORDER)

ARRAYS = {"jax", "numpy", "jaxtyping"}
SOLVERS = ARRAYS | {"flax", "optax"}
STEPPING = ARRAYS | {"gymnasium", "stable_baselines3.common.vec_env"}
LEARNING = SOLVERS | {"gymnasium", "stable_baselines3", "sbx", "cmaes", "torch", "rich", "tqdm"}
TABLES = {"pandas", "rich", "yaml"}

LIBRARIES = {
    "errors": set(),
    "lazy": set(),
    "core": ARRAYS,
    "data": ARRAYS | TABLES | {"scipy", "minari"},
    "data/reading/hdf5.py": {"h5py"},
    "data/reading/matlab.py": {"h5py"},
    "data/reading/parquet.py": {"pyarrow"},
    "data/reading/ros.py": {"rosbags"},
    "twins": ARRAYS | {"mujoco"},
    "effects": ARRAYS,
    "effects/neural.py": SOLVERS,
    "planning": SOLVERS,
    "sysid": SOLVERS | TABLES | {"scipy", "jinja2"},
    "sysid/reporting/film.py": {"imageio_ffmpeg"},
    "envs": STEPPING | {"mujoco"},
    "wrappers": STEPPING,
    "wrappers/safety/shield.py": {"daqp"},
    "wrappers/vec_env.py": {
        "stable_baselines3.common.env_util",
        "stable_baselines3.common.monitor",
    },
    "algos": LEARNING,
    "deploy": LEARNING | {"jax2onnx", "onnx", "onnxruntime"},
    "experiments": LEARNING | TABLES | {"scipy", "jinja2", "rliable", "ray"},
    "cli": LEARNING | TABLES,
    "rl_zoo_plugin": {"rl_zoo3", "optuna"},
    "rl_zoo_plugin/callbacks.py": {"stable_baselines3", "numpy"},
    "rl_zoo_plugin/hub.py": {"huggingface_hub", "requests"},
    "rl_zoo_plugin/storages.py": {"sqlalchemy"},
}
"""What a layer, or one file of it, imports from outside; the standard library is free."""

LATE = {
    # `Twin.extend` makes one, inside the method.
    ("sb3_hds.core.twin", "sb3_hds.core.extended"),
    # Methods of an effect take a twin: a name in annotations alone.
    ("sb3_hds.core.effect", "sb3_hds.core.twin"),
}
"""Imports that close a circle and may."""

TANGLED = {"sysid": 5}
"""How many files of a layer import each other in a circle: to become fewer, never more."""

ROOMS_OF_SYSID = (
    {"progress", "measurements"},
    {"motion"},
    {"estimation"},
    {"equation"},
    {"checks", "comparison"},
    {"belief"},
    {"design"},
    {"reporting"},
    {"diagnosis"},
)
"""Folders and files of system identification: each imports those before it."""

UPWARD = {
    # Results draw themselves, inside methods.
    ("sb3_hds.sysid.estimation.results", "sb3_hds.sysid.reporting.figures"),
    ("sb3_hds.sysid.design.result", "sb3_hds.sysid.reporting.figures"),
    ("sb3_hds.sysid.design.experiment", "sb3_hds.sysid.reporting.wording"),
}
"""Imports of a later folder: to become fewer, never more."""

DRAWING = {"figures.py", "film.py", "rendering.py", "report.py"}
"""Files that may import matplotlib, inside functions."""


def left_of(layer: str) -> set[str]:
    position = next(i for i, layers in enumerate(ORDER) if layer in layers)
    return set().union(*ORDER[:position])


def imports(tree: ast.AST) -> Iterator[str]:
    """Every module that is named in an import, at the top of a file or inside a function."""
    for node in ast.walk(tree):
        match node:
            case ast.Import(names=names):
                yield from (alias.name for alias in names)
            case ast.ImportFrom(module="sb3_hds", names=names, level=0):
                layers = {alias.name for alias in names} & ALL
                yield from (f"sb3_hds.{layer}" for layer in layers)
                yield from ["sb3_hds"] * (len(layers) < len(names))
            case ast.ImportFrom(module=module, level=0):
                yield module or ""
            case ast.ImportFrom(level=level):
                yield "." * level
            case ast.Call(
                func=ast.Name("import_module") | ast.Attribute(attr="import_module"),
                args=[ast.Constant(value=str(module)), *_],
            ):
                yield module


def imports_at_the_top(tree: ast.Module) -> Iterator[str]:
    for statement in tree.body:
        if not isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield from imports(statement)


def names_in(path: str, modules: Collection[str]) -> Iterator[str]:
    """Modules among these that a file imports, by their own names or by names in them."""
    for node in ast.walk(ast.parse((ROOT / path).read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            whole = (f"{node.module}.{alias.name}" for alias in node.names)
            yield from (name if name in modules else node.module for name in whole)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def in_circles(imported: Mapping[str, set[str]]) -> set[str]:
    """
    :param imported: by module, what it imports
    :return: the modules that import themselves by way of others
    """

    def reached(module: str) -> set[str]:
        found, new = set(), imported[module]
        while new:
            found |= new
            new = set().union(*(imported.get(name, set()) for name in new)) - found
        return found

    return {module for module in imported if module in reached(module)}


def objection(path: str, module: str) -> str | None:
    """
    :param path: relative to the root of the checkout, with slashes
    :param module: what the file imports
    :return: what the rule says against it, if anything
    """
    package, *inside = path.removesuffix(".py").split("/")
    layer = package if package == "rl_zoo_plugin" else inside[0]
    top, *rest = module.split(".")
    match top:
        case "":
            return "write the whole name instead of a relative import"
        case "sb3_hds" if not rest:
            return None if layer == "rl_zoo_plugin" else "nothing below imports the package root"
        case "sb3_hds":
            fine = rest[0] in left_of(layer) | {layer}
        case "matplotlib":
            fine = Path(path).name in DRAWING
        case _:
            libraries = LIBRARIES[layer] | LIBRARIES.get(path.removeprefix("sb3_hds/"), set())
            fine = top in {layer, *sys.stdlib_module_names} or any(
                f"{module}.".startswith(f"{library}.") for library in libraries
            )
    return None if fine else f"{layer} may not import {module}"


def violations(path: str, source: str) -> list[str]:
    """:return: one sentence for each import of the file that the rule forbids"""
    tree = ast.parse(source)
    found = [f"{path}: {words}" for module in imports(tree) if (words := objection(path, module))]
    if any(module.split(".")[0] == "matplotlib" for module in imports_at_the_top(tree)):
        found.append(f"{path}: matplotlib is imported inside functions only")
    return found


def test_files_import_to_the_left_and_only_the_libraries_of_their_layers():
    files = [*ROOT.glob("sb3_hds/**/*.py"), *ROOT.glob("rl_zoo_plugin/**/*.py")]
    # The root of the package may import everything.
    paths = {file.relative_to(ROOT).as_posix(): file for file in files}
    paths.pop("sb3_hds/__init__.py")

    assert [
        words for path, file in paths.items() for words in violations(path, file.read_text())
    ] == []


def modules_with_imports(pattern: str) -> dict[str, set[str]]:
    """:return: by module, what it imports"""
    paths = [path.relative_to(ROOT) for path in ROOT.glob(pattern)]
    modules = {
        ".".join(path.with_suffix("").parts).removesuffix(".__init__"): path.as_posix()
        for path in paths
    }
    return {module: set(names_in(path, modules)) for module, path in modules.items()}


def test_files_of_a_folder_do_not_import_each_other_in_circles():
    imported = {
        module: {name for name in names if (module, name) not in LATE}
        for module, names in modules_with_imports("sb3_hds/**/*.py").items()
    }

    left = Counter(module.split(".")[1] for module in in_circles(imported))

    assert left == TANGLED


def test_rooms_of_system_identification_import_those_before_them():
    place = {room: n for n, rooms in enumerate(ROOMS_OF_SYSID) for room in rooms}
    inside = modules_with_imports("sb3_hds/sysid/**/*.py")

    del inside["sb3_hds.sysid"]

    def room(module: str) -> str:
        return module.split(".")[2]

    upward = {
        (module, name)
        for module, names in inside.items()
        for name in names & inside.keys()
        if place[room(name)] >= place[room(module)] and room(name) != room(module)
    }

    assert upward == UPWARD


def test_circles_are_found_without_what_leads_from_one_to_another():
    imported = {"a": {"b"}, "b": {"a", "c"}, "c": {"d"}, "d": {"e"}, "e": {"d", "f"}, "f": set()}

    assert in_circles(imported) == {"a", "b", "d", "e"}


def test_every_folder_is_a_layer():
    folders = {path.name for path in (ROOT / "sb3_hds").iterdir() if any(path.glob("*.py"))}

    assert folders <= ALL == {layer for layer in LIBRARIES if not layer.endswith(".py")}


def test_the_rule_forbids_what_it_should():
    for path, source in (
        ("sb3_hds/twins/environments/pendulum.py", "import sb3_hds.effects.joint"),
        ("sb3_hds/planning/ilqr.py", "import importlib\nimportlib.import_module('sb3_hds.algos')"),
        ("sb3_hds/envs/mirror.py", "from sb3_hds import twins, HDS"),
        ("sb3_hds/algos/twin/hds/algorithm.py", "from .networks import Policy"),
        ("sb3_hds/envs/twin_env.py", "from stable_baselines3.sac import SAC"),
        ("sb3_hds/sysid/reporting/figures.py", "if True:\n    import matplotlib"),
    ):
        assert len(violations(path, source)) == 1, source
