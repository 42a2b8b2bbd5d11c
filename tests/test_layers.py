"""The import rule of the design: layers import to the left, and libraries where they belong."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent

ORDER = (
    {"errors"},
    {"core"},
    {"data", "twins", "effects"},
    {"planning", "sysid"},
    {"envs", "wrappers"},
    {"algos"},
    {"deploy", "experiments"},
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
    "sysid/film.py": {"imageio_ffmpeg"},
    "envs": STEPPING | {"mujoco"},
    "wrappers": STEPPING,
    "wrappers/low_pass.py": {"scipy"},
    "wrappers/projection.py": {"daqp"},
    "wrappers/gymnasium_vec_env.py": {"stable_baselines3.common.monitor"},
    "algos": LEARNING,
    "deploy": LEARNING | {"onnx", "onnxruntime"},
    "experiments": LEARNING | TABLES | {"scipy"},
    "cli": LEARNING | TABLES,
    "rl_zoo_plugin": {"rl_zoo3", "optuna"},
    "rl_zoo_plugin/compilation_cache.py": {"jax"},
    "rl_zoo_plugin/trial_progress.py": {"stable_baselines3"},
}
"""What a layer, or one file of it, imports from outside; the standard library is free."""

DRAWING = {"plots.py", "rendering.py", "report.py"}
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


def test_every_folder_is_a_layer():
    folders = {path.name for path in (ROOT / "sb3_hds").iterdir() if any(path.glob("*.py"))}

    assert folders <= ALL == {layer for layer in LIBRARIES if not layer.endswith(".py")}


def test_the_rule_forbids_what_it_should():
    for path, source in (
        ("sb3_hds/twins/pendulum.py", "import sb3_hds.effects.joint"),
        ("sb3_hds/planning/ilqr.py", "import importlib\nimportlib.import_module('sb3_hds.algos')"),
        ("sb3_hds/envs/mirror.py", "from sb3_hds import twins, HDS"),
        ("sb3_hds/algos/twin/hds/algorithm.py", "from .networks import Policy"),
        ("sb3_hds/envs/twin_env.py", "from stable_baselines3.sac import SAC"),
        ("sb3_hds/sysid/plots.py", "if True:\n    import matplotlib"),
    ):
        assert len(violations(path, source)) == 1, source
