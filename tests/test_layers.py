"""The import rule of the design: layers import to the left, and libraries where they belong."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

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
SOLVERS = ARRAYS | {"flax", "optax", "optimistix"}
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


def layer_of(path: str) -> str:
    """:return: ``"core"`` of ``"sb3_hds/core/twin.py"``, ``"errors"`` of ``"sb3_hds/errors.py"``"""
    package, *inside = path.removesuffix(".py").split("/")
    return package if package == "rl_zoo_plugin" else inside[0]


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
    layer = layer_of(path)
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


def checked_files() -> list[str]:
    """All source files but the root of the package, which may import everything."""
    files = [*ROOT.glob("sb3_hds/**/*.py"), *ROOT.glob("rl_zoo_plugin/**/*.py")]
    paths = sorted(file.relative_to(ROOT).as_posix() for file in files)
    return [path for path in paths if path != "sb3_hds/__init__.py"]


@pytest.mark.parametrize("path", checked_files())
def test_a_file_imports_to_the_left_and_only_the_libraries_of_its_layer(path):
    assert violations(path, (ROOT / path).read_text()) == []


def test_every_folder_is_a_layer():
    folders = {path.name for path in (ROOT / "sb3_hds").iterdir() if any(path.glob("*.py"))}

    assert folders <= ALL == {layer for layer in LIBRARIES if not layer.endswith(".py")}


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("sb3_hds/core/twin.py", "from sb3_hds.twins import make"),
        ("sb3_hds/twins/pendulum.py", "import sb3_hds.effects.joint"),
        ("sb3_hds/planning/ilqr.py", "def plan():\n    from sb3_hds.envs import TwinEnv"),
        ("sb3_hds/planning/ilqr.py", "import importlib\nimportlib.import_module('sb3_hds.algos')"),
        ("sb3_hds/planning/ilqr.py", "from sb3_hds import envs"),
        ("sb3_hds/envs/mirror.py", "from sb3_hds import twins, HDS"),
        ("sb3_hds/algos/hds.py", "import sb3_hds"),
        ("sb3_hds/algos/hds.py", "from .networks import Policy"),
        ("sb3_hds/algos/hds.py", "from rl_zoo_plugin import tables"),
        ("sb3_hds/core/twin.py", "import flax"),
        ("sb3_hds/effects/joint.py", "import optax"),
        ("sb3_hds/envs/twin_env.py", "from stable_baselines3.sac import SAC"),
        ("sb3_hds/envs/twin_env.py", "from sbx import SAC"),
        ("sb3_hds/sysid/fit.py", "def draw():\n    import matplotlib"),
        ("sb3_hds/sysid/plots.py", "from matplotlib import pyplot"),
        ("sb3_hds/sysid/plots.py", "if True:\n    import matplotlib"),
    ],
)
def test_the_rule_forbids(path, source):
    assert len(violations(path, source)) == 1


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("sb3_hds/core/twin.py", "import jax.numpy as jnp\nfrom sb3_hds.errors import NoTwinError"),
        ("sb3_hds/core/twin.py", "import math\nfrom sb3_hds.core.effect import Effect"),
        ("sb3_hds/envs/mirror.py", "from sb3_hds import effects, twins"),
        ("sb3_hds/effects/neural.py", "import flax.linen as nn"),
        ("sb3_hds/envs/twin_vec_env.py", "from stable_baselines3.common.vec_env import VecEnv"),
        ("sb3_hds/sysid/plots.py", "def draw():\n    from matplotlib import pyplot"),
        ("sb3_hds/cli/diagnose.py", "def main():\n    from sb3_hds.experiments import gain"),
        ("rl_zoo_plugin/tables.py", "import sb3_hds"),
    ],
)
def test_the_rule_allows(path, source):
    assert violations(path, source) == []
