"""
The test files of Stable-Baselines3 and SB3-Contrib, run on our classes in place of theirs.

    pip download --no-binary :all: --no-deps stable-baselines3==2.9.2 sb3-contrib==2.9.2
    tar xzf stable_baselines3-2.9.2.tar.gz && tar xzf sb3_contrib-2.9.2.tar.gz
    python benchmarks/sb3_tests.py stable_baselines3-2.9.2 sb3_contrib-2.9.2

The files are unchanged: this script is also a pytest plugin, which binds the name that they import
(``SAC``) to our class before they are read, and selects the cases that use it. Classes that are
already in the table are not run again.
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
from runs import CACHE, RESULTS, resume

#: for each row of the table, the class that is replaced, and ours
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
#: of a class, cases that are not run: networks of 134 million weights, held twice with everything
#: that TD7 learns by, do not fit into 24 GiB
_TOO_LARGE = {"TD7": ["tests/test_save_load.py::test_save_load_large_model"]}
#: reason of a failure, by words in its message
REASONS = {
    "images": "image",
    "torch objects": "features_extractor_class|log_ent_coef|state_dict",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("sources", nargs="+", type=Path, help="unpacked sources, each with tests/")
    parser.add_argument("--rows", nargs="+", choices=REPLACED, default=list(REPLACED))
    parser.add_argument("-k", default="", help="only cases that match, as in pytest")
    arguments = parser.parse_args()
    sources = {package_of(source): source.resolve() for source in arguments.sources}
    package = {row: REPLACED[row][0].partition(".")[0] for row in arguments.rows}
    work = lambda row: run(row, sources[package[row]], arguments.k)  # noqa: E731
    wanted = [row for row in arguments.rows if package[row] in sources]
    if arguments.k:
        cases = [{"class": row} | case for row in wanted for case in work(row)]
        report(pd.DataFrame(cases), kept=False)
        return
    resume("sb3_tests", ("class",), [(row,) for row in wanted], work, jobs=1)
    report(pd.read_csv(RESULTS / "sb3_tests.csv", keep_default_na=False), kept=True)


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
        command += [f"--deselect={case}" for case in _TOO_LARGE.get(row, [])]
        done = subprocess.run(command, cwd=source, env=surroundings, stdout=subprocess.DEVNULL)
        if not report.exists():
            raise RuntimeError(f"pytest ended with {done.returncode} before it had finished.")
        return [outcome(case) for case in ElementTree.parse(report).iter("testcase")]


def outcome(case: ElementTree.Element) -> dict[str, Any]:
    """:return: what pytest reports of one case"""
    found = next((part for part in case if part.tag in ("failure", "error", "skipped")), None)
    kinds = {"failure": "failed", "error": "error", "skipped": "skipped"}
    return {
        "case": f"{case.get('classname', '').removeprefix('tests.')}::{case.get('name')}",
        "outcome": "passed" if found is None else kinds[found.tag],
        "message": "" if found is None else (found.get("message") or "").splitlines()[0],
    }


def report(cases: pd.DataFrame, kept: bool) -> None:
    """
    Print how many cases of each class ended how, and each that failed for no known reason.

    :param kept: whether the counts are written beside the cases
    """
    counted = table(cases)
    print(counted.to_string())
    if kept:
        counted.to_csv(RESULTS / "sb3_tests_table.csv")
    for _, case in cases[cases["reason"] == "other"].iterrows():
        print(f"{case['class']:16} {case['case']}\n{'':16} {case['message']}")


def table(cases: pd.DataFrame) -> pd.DataFrame:
    """
    Count cases, and among those that failed the reasons.

    :param cases: gets a column ``reason``
    :return: a row for each class
    """
    failed = cases["outcome"].isin(("failed", "error"))
    cases["reason"] = ""
    cases.loc[failed, "reason"] = "other"
    for reason, pattern in REASONS.items():
        cases.loc[failed & cases["message"].str.contains(pattern), "reason"] = reason
    ends = cases["outcome"].where(~failed, cases["reason"])
    columns = ["passed", "skipped", *REASONS, "other"]
    return pd.crosstab(cases["class"], ends).reindex(columns=columns, fill_value=0)


# --- the plugin


def pytest_configure(config: Any) -> None:
    """Replace the class that the tests import by ours."""
    if _ROW in os.environ:
        stock, ours = REPLACED[os.environ[_ROW]]
        package, _, name = stock.partition(".")
        module = import_module(package)
        config.stash_of_sb3_tests = (name, getattr(import_module("sb3_hds"), ours))
        setattr(module, name, config.stash_of_sb3_tests[1])


def pytest_collection_modifyitems(config: Any, items: list[Any]) -> None:
    """Deselect cases that do not use the replaced class."""
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
