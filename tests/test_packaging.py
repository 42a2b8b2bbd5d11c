"""What is built, what an installation changes, and what importing costs."""

import os
import re
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest

from rl_zoo_plugin.tables import ALGORITHMS

ROOT = Path(__file__).parent.parent
needs_build = pytest.mark.skipif(
    not (find_spec("build") and find_spec("hatchling")), reason="needs the extra 'dev'"
)
needs_zoo = pytest.mark.skipif(find_spec("rl_zoo3") is None, reason="needs the extra 'zoo'")

REPORT = """
import rl_zoo3, sb3_hds
from rl_zoo_plugin.tables import hyperparams_file
print(sb3_hds.__file__, sb3_hds.__version__, "hds" in rl_zoo3.ALGOS, hyperparams_file("hds"))
"""


def run(*words: str | Path, **environ: str) -> subprocess.CompletedProcess:
    """Outside the checkout, which would otherwise be what an interpreter imports."""
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [str(word) for word in words]
    return subprocess.run(
        command, cwd=ROOT.parent, env=clean | environ, text=True, capture_output=True, timeout=300
    )


def succeeds(*words: str | Path, **environ: str) -> str:
    done = run(*words, **environ)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


class Environment:
    """A virtual environment that has the dependencies of this one, but not its `sb3-hds`."""

    def __init__(self, folder: Path) -> None:
        venv.create(folder, with_pip=False)
        self.python = folder / "bin" / "python"
        self.site_packages = next(folder.glob("lib/python*/site-packages"))
        # A folder on the path has its own .pth files ignored: the editable install is not seen.
        there = sysconfig.get_path("purelib")
        (self.site_packages / "dependencies.pth").write_text(f"{there}\n")

    def install(self, *what: str | Path) -> None:
        pip = (sys.executable, "-m", "pip", "--python", self.python)
        options = ("--no-deps", "--no-build-isolation", "--no-index", "--ignore-installed")
        succeeds(*pip, "install", *options, *what)

    def files(self) -> set[str]:
        return {path.name for path in self.site_packages.iterdir()}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Built from the source distribution, so that both are known to be complete."""
    folder = tmp_path_factory.mktemp("dist")
    succeeds(sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, ROOT)
    return next(folder.glob("*.whl"))


@pytest.fixture(scope="module")
def installed(tmp_path_factory, wheel) -> Environment:
    environment = Environment(tmp_path_factory.mktemp("wheel"))
    environment.install(wheel)
    return environment


def test_an_extra_is_one_that_something_uses_and_the_documentation_lists():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    files = [*ROOT.glob("sb3_hds/**/*.py"), *ROOT.glob("rl_zoo_plugin/**/*.py")]
    source = "\n".join(file.read_text() for file in files)
    listed = re.findall(r"^\| `(\w+)` \|", (ROOT / "docs/guide/install.md").read_text(), re.M)

    assert set(listed) == set(extras)
    for name in set(extras) - {"dev"}:
        packages = [re.split(r"[\[>=<!]", package)[0] for package in extras[name]]
        assert any(re.search(rf"\b{package}\b", source) for package in packages), name


@needs_build
def test_the_wheel_holds_both_packages_the_yml_files_and_the_start_up_files(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())

    files = {f"rl_zoo_plugin/hyperparams/{algo}.yml" for algo in ALGORITHMS}
    files |= {"sb3_hds/__init__.py", "sb3_hds/py.typed", "rl_zoo_plugin/hook.py"}
    assert files | {"sb3_hds.pth", "sb3_hds.start"} <= names
    folders = {name.split("/")[0] for name in names if ".dist-info" not in name}
    assert folders == {"sb3_hds", "rl_zoo_plugin", "sb3_hds.pth", "sb3_hds.start"}


def test_both_start_up_files_call_the_same_function():
    line = (ROOT / "rl_zoo_plugin" / "sb3_hds.pth").read_text().strip()
    entry = (ROOT / "rl_zoo_plugin" / "sb3_hds.start").read_text().strip()

    module, function = entry.split(":")
    assert line == f"import {module}; {module}.{function}()"


@needs_build
@needs_zoo
def test_the_stock_zoo_knows_our_algorithms_after_the_wheel_is_installed(installed):
    package, version, known, hyperparams = succeeds(installed.python, "-c", REPORT).split()

    assert Path(package).parent.parent == installed.site_packages
    assert version == "0.1.0" and known == "True"
    assert Path(hyperparams) == installed.site_packages / "rl_zoo_plugin/hyperparams/hds.yml"
    assert Path(hyperparams).is_file()


@needs_build
@needs_zoo
def test_the_stock_zoo_knows_our_algorithms_after_an_editable_install(tmp_path):
    environment = Environment(tmp_path)
    environment.install("-e", ROOT)

    package, _, known, hyperparams = succeeds(environment.python, "-c", REPORT).split()

    assert Path(package) == ROOT / "sb3_hds" / "__init__.py"
    assert known == "True"
    assert Path(hyperparams) == ROOT / "hyperparams" / "hds.yml"


@needs_build
def test_an_interpreter_starts_with_nothing_but_the_hook_and_in_5_ms_more(installed):
    started, without = (
        set(
            succeeds(
                installed.python, *option, "-c", "import sys, site; print(*sys.modules)"
            ).split()
        )
        for option in ((), ("-S",))
    )
    assert started - without <= {"sitecustomize", "rl_zoo_plugin", "rl_zoo_plugin.hook"}

    # The best of ten: what else the machine does only adds to it.
    reports = [run(installed.python, "-X", "importtime", "-c", "pass").stderr for _ in range(10)]
    cumulative = r"\|\s*(\d+) \|\s+rl_zoo_plugin\.hook\n"
    assert min(int(re.search(cumulative, report)[1]) for report in reports) < 5000  # [us]


@needs_build
def test_an_interpreter_starts_with_a_broken_hook_and_uninstalling_leaves_nothing(tmp_path, wheel):
    environment = Environment(tmp_path)
    environment.install(wheel)
    hook = environment.site_packages / "rl_zoo_plugin" / "hook.py"
    works = hook.read_text()
    for text in ("raise ImportError('broken')", None):
        hook.write_text(text) if text else hook.unlink()
        assert succeeds(environment.python, "-c", "print(1)") == "1\n"
    hook.write_text(works)

    # Only what lies in this environment is uninstalled, not the packages that it borrows.
    (environment.site_packages / "dependencies.pth").write_text("# nothing\n")
    pip = (sys.executable, "-m", "pip", "--python", environment.python)
    succeeds(*pip, "uninstall", "-y", "sb3-hds")

    assert environment.files() == {"dependencies.pth"}


def test_importing_the_package_costs_little_more_than_gymnasium_and_registers_environments():
    code = "import {}, sys; print(*sys.modules, *gymnasium.registry)".format
    ours, theirs = (
        set(succeeds(sys.executable, "-c", code(package)).split())
        for package in ("gymnasium, sb3_hds", "gymnasium")
    )

    assert {name for name in ours - theirs if not name.startswith("sb3_hds/")} == {
        *("sb3_hds", "sb3_hds.envs", "sb3_hds.envs.registration")
    }
    assert "sb3_hds/CartPoleSwingUp-v0" in ours and not {"jax", "torch", "pandas"} & ours


def test_who_learns_without_a_twin_does_not_wait_for_what_fits_one_to_data():
    names = "BRO, GSDESAC, TD7, TQC, CrossQ, DroQ, SimbaSAC, load_policy"
    code = (
        f"from sb3_hds import {names}; import sys; "
        "print(*{'optimistix', 'cmaes', 'sb3_hds.sysid', 'sb3_hds.twins'} & set(sys.modules))"
    )

    assert succeeds(sys.executable, "-c", code).split() == []


def test_public_names_are_listed_and_exist():
    import sb3_hds

    assert set(sb3_hds.__all__) <= set(dir(sb3_hds))
    for name in sb3_hds.__all__:
        assert getattr(sb3_hds, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'HSD'"):
        sb3_hds.HSD  # noqa: B018
