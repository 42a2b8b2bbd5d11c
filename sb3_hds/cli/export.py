"""``sb3-hds export``."""

import argparse
import contextlib
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sb3_hds.cli.classes import wrapped, wrapper
from sb3_hds.cli.settings import yml_setting


def add_arguments(command: argparse.ArgumentParser) -> None:
    """:param command: that is to understand them"""
    command.add_argument(
        "model", metavar="MODEL", help="zip file of a saved model, or an .onnx file, for --c"
    )
    command.add_argument("onnx", nargs="?", metavar="FILE.onnx", help="ONNX file to write")
    command.add_argument("--c", metavar="FILE.h", help="header of C99 to write")
    command.add_argument(
        "--algo",
        help="id in the zoo, or a class, sbx.SAC: who saved the model, where that was another "
        "library; its file is then unpickled",
    )
    command.add_argument("--env", help="as trained in: tells names, units, the length of a step")
    command.add_argument("--env-kwargs", nargs="*", default=[], metavar="NAME:VALUE")
    command.add_argument(
        "--env-wrapper",
        nargs="*",
        default=[],
        metavar="CLASS",
        help="as trained, the one next to the environment first, as in 'sb3-hds robustness'; those "
        "of sb3_hds.wrappers that are functions go into the file",
    )
    command.add_argument(
        "--vecnormalize", metavar="FILE.pkl", help="of the training; it is unpickled"
    )
    command.add_argument(
        "--no-layers", action="store_true", help="leave all wrappers to where the file runs"
    )
    command.add_argument("--dt", type=float, help="how long a step is [s]")


def run(given: argparse.Namespace) -> None:
    """Export, and tell what was written."""
    from sb3_hds.core.trajectories.storage import check_target
    from sb3_hds.deploy import export_c, export_onnx
    from sb3_hds.errors import ParameterError

    exported = Path(given.model).suffix == ".onnx"
    if exported and given.onnx:
        raise ParameterError(
            f"{given.model} is exported already. Name a saved model, or only --c {given.onnx}."
        )
    if not (given.onnx or given.c):
        raise ParameterError("Name a file to write: policy.onnx, or --c policy.h.")
    if given.onnx and Path(given.onnx).suffix != ".onnx":
        raise ParameterError(f"The file to write must end in .onnx, got '{given.onnx}'.")
    for target in filter(None, (given.onnx, given.c)):
        check_target(target)
    with _environment(given) as env, tempfile.TemporaryDirectory() as folder:
        source = given.model
        if not exported:
            source = given.onnx or str(Path(folder, f"{Path(given.model).stem}.onnx"))
            done = export_onnx(
                _model(given),
                source,
                env=env,
                layers=not given.no_layers,
                normalize=given.vecnormalize,
                dt=given.dt,
            )
            if given.onnx:
                print(done)
        if given.c:
            print(export_c(source, given.c))


@contextlib.contextmanager
def _environment(given: argparse.Namespace) -> Iterator[Any]:
    from sb3_hds.cli.robustness import _made

    if given.env is None:
        yield None
        return
    wrappers = [wrapper(text) for text in given.env_wrapper]
    env = _made(given.env, dict(map(yml_setting, given.env_kwargs)))
    try:
        yield wrapped(wrappers, env)
    finally:
        env.close()


def _model(given: argparse.Namespace) -> Any:
    """
    :raises FileNotFoundError: for a file that there is not, with the nearest that there is
    :raises ParameterError: for a file that holds no such model
    """
    from sb3_hds.algos import load_policy
    from sb3_hds.cli.robustness import _loaded
    from sb3_hds.errors import ParameterError, did_you_mean

    if given.algo is not None:
        return _loaded(given.algo, given.model)
    file = Path(given.model)
    if not file.is_file() and not file.with_name(f"{file.name}.zip").is_file():
        beside = [str(found) for found in file.parent.glob("*.zip")]
        raise FileNotFoundError(
            f"There is no model '{given.model}'.{did_you_mean(given.model, beside)}"
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return load_policy(given.model)
    except ValueError as error:
        raise ParameterError(
            f"{error} Of Stable-Baselines3 or SBX, say which algorithm: --algo sac, --algo "
            "sbx.SAC; the file is then unpickled."
        ) from error
