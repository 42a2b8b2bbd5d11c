"""
Run the test files of Stable-Baselines3 and SB3-Contrib on our classes, in the place of theirs.

    pip download --no-binary :all: --no-deps stable-baselines3==2.9.2 sb3-contrib==2.9.2
    tar xzf stable_baselines3-2.9.2.tar.gz && tar xzf sb3_contrib-2.9.2.tar.gz
    python benchmarks/sb3_tests.py stable_baselines3-2.9.2 sb3_contrib-2.9.2

Nothing in those files is changed: this file is also a plugin of pytest, which binds the name that
they import (``SAC``) to our class before they are read, and picks the cases that use it.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pandas as pd
from runs import CACHE, save

#: of each row of the table: the class that is replaced, and ours
REPLACED = {
    "GSDESAC": ("stable_baselines3.SAC", "GSDESAC"),
    "DroQ": ("stable_baselines3.SAC", "DroQ"),
    "SimbaSAC": ("stable_baselines3.SAC", "SimbaSAC"),
    "BRO": ("stable_baselines3.SAC", "BRO"),
    "TQC": ("stable_baselines3.SAC", "TQC"),
    "CrossQ": ("stable_baselines3.SAC", "CrossQ"),
    "TD7": ("stable_baselines3.TD3", "TD7"),
    "TQC, contrib": ("sb3_contrib.TQC", "TQC"),
    "CrossQ, contrib": ("sb3_contrib.CrossQ", "CrossQ"),
}
_ROW = "SB3_TESTS_ROW"
# It needs the games of the Arcade Learning Environment, and no algorithm.
_IGNORED = "tests/test_utils.py"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("sources", nargs="+", type=Path, help="unpacked sources, each with tests/")
    parser.add_argument("--rows", nargs="+", choices=REPLACED, default=list(REPLACED))
    parser.add_argument("-k", default="", help="only cases that match, as in pytest")
    arguments = parser.parse_args()
    sources = {package_of(source): source.resolve() for source in arguments.sources}
    cases = []
    for row in arguments.rows:
        package = REPLACED[row][0].partition(".")[0]
        if package in sources:
            cases += run(row, sources[package], arguments.k)
            print(table(cases).to_string(), flush=True)
    for case in cases:
        if case["outcome"] in ("failed", "error"):
            print(f"{case['class']:16} {case['case']}\n{'':16} {case['message']}")
    if set(arguments.rows) == set(REPLACED) and not arguments.k:
        save(cases, "sb3_tests")


def package_of(source: Path) -> str:
    """:return: name of the package whose sources these are"""
    for package in ("stable_baselines3", "sb3_contrib"):
        if (source / package).is_dir() and (source / "tests").is_dir():
            return package
    sys.exit(f"{source} holds neither stable_baselines3 nor sb3_contrib with their tests.")


def run(row: str, source: Path, matching: str) -> list[dict[str, Any]]:
    """:return: a dictionary for each case of the sources' tests"""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        here = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
        surroundings = {
            "JAX_COMPILATION_CACHE_DIR": str(CACHE / "compiled"),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.2",
            **os.environ,
            _ROW: row,
            "PYTHONPATH": here,
        }
        command = [sys.executable, "-m", "pytest", "tests", "-q", "-p", "sb3_tests", "-p"]
        command += ["no:cacheprovider", f"--junitxml={report}", f"--ignore={_IGNORED}"]
        command += ["-k", matching] if matching else []
        subprocess.run(command, cwd=source, env=surroundings, stdout=subprocess.DEVNULL)
        return [outcome(row, case) for case in ElementTree.parse(report).iter("testcase")]


def outcome(row: str, case: ElementTree.Element) -> dict[str, Any]:
    """:return: what pytest reports of one case"""
    found = next((part for part in case if part.tag in ("failure", "error", "skipped")), None)
    kinds = {"failure": "failed", "error": "error", "skipped": "skipped"}
    return {
        "class": row,
        "case": f"{case.get('classname', '').removeprefix('tests.')}::{case.get('name')}",
        "outcome": "passed" if found is None else kinds[found.tag],
        "message": "" if found is None else (found.get("message") or "").splitlines()[0],
    }


def table(cases: list[dict[str, Any]]) -> pd.DataFrame:
    """:return: by class, how many cases ended how"""
    counted = pd.DataFrame(cases).groupby(["class", "outcome"], sort=False).size()
    return counted.unstack(fill_value=0)


# --- the plugin


def pytest_configure(config: Any) -> None:
    """Put our class where the tests import theirs from."""
    if _ROW in os.environ:
        stock, ours = REPLACED[os.environ[_ROW]]
        package, _, name = stock.partition(".")
        module = import_module(package)
        config.stash_of_sb3_tests = (name, getattr(import_module("sb3_hds"), ours))
        setattr(module, name, config.stash_of_sb3_tests[1])


def pytest_collection_modifyitems(config: Any, items: list[Any]) -> None:
    """Leave out what does not use the replaced class."""
    if _ROW in os.environ:
        name, ours = config.stash_of_sb3_tests
        items[:] = [item for item in items if uses(item, name, ours)]


def uses(item: Any, name: str, ours: type) -> bool:
    """:return: whether a case is about our class: its argument, or in the test's own code"""
    given = getattr(item, "callspec", None)
    arguments = list(given.params.values()) if given else []
    if any(isinstance(each, type) and hasattr(each, "learn") for each in arguments):
        return ours in arguments
    if any(isinstance(each, str) and each == name.lower() for each in arguments):
        return True
    return name in item.function.__code__.co_names


if __name__ == "__main__":
    main()
