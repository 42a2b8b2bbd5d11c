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

from sb3_hds.algos.registry import ALGORITHMS

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


def succeeds(*words: str | Path) -> str:
    """Outside the checkout, which would otherwise be what an interpreter imports."""
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [str(word) for word in words]
    done = subprocess.run(
        command, cwd=ROOT.parent, env=clean, text=True, capture_output=True, timeout=300
    )
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


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Built from the source distribution, so that both are known to be complete."""
    folder = tmp_path_factory.mktemp("dist")
    succeeds(sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, ROOT)
    return next(folder.glob("*.whl"))


def test_an_extra_is_one_that_something_uses_and_the_documentation_lists():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    files = [*ROOT.glob("sb3_hds/**/*.py"), *ROOT.glob("rl_zoo_plugin/**/*.py")]
    source = "\n".join(file.read_text() for file in files)
    listed = re.findall(r"^\| `(\w+)` \|", (ROOT / "docs/guide/install.md").read_text(), re.M)

    assert set(listed) == set(extras)
    for name in set(extras) - {"dev", "wandb"}:  # the zoo imports that, see test_tracking
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
    plugin = ROOT / "rl_zoo_plugin"
    line, entry = ((plugin / f"sb3_hds.{kind}").read_text() for kind in ("pth", "start"))
    module, function = entry.strip().split(":")
    assert line.strip() == f"import {module}; {module}.{function}()"


@needs_build
@needs_zoo
def test_with_the_wheel_the_zoo_knows_our_algorithms_and_python_starts_as_before(tmp_path, wheel):
    environment = Environment(tmp_path)
    environment.install(wheel)
    python, folder = environment.python, environment.site_packages

    package, version, known, hyperparams = succeeds(python, "-c", REPORT).split()
    assert Path(package).parent.parent == folder and (version, known) == ("0.1.0", "True")
    assert Path(hyperparams) == folder / "rl_zoo_plugin/hyperparams/hds.yml"
    assert Path(hyperparams).is_file()

    command = ("-c", "import sys, site; print(*sys.modules)")
    started, without = (
        set(succeeds(python, *option, *command).split()) for option in ((), ("-S",))
    )
    assert started - without <= {"sitecustomize", "rl_zoo_plugin", "rl_zoo_plugin.hook"}

    hook = folder / "rl_zoo_plugin" / "hook.py"
    works = hook.read_text()
    hook.write_text("raise ImportError('broken')")
    assert succeeds(python, "-c", "print(1)") == "1\n"
    hook.write_text(works)
    # Only what lies in this environment is uninstalled, not the packages that it borrows.
    (folder / "dependencies.pth").write_text("# nothing\n")
    pip = (sys.executable, "-m", "pip", "--python", python)
    succeeds(*pip, "uninstall", "-y", "sb3-hds")
    assert {path.name for path in folder.iterdir()} == {"dependencies.pth"}


def test_importing_brings_nothing_but_environments_and_a_learner_not_what_fits_twins_to_data():
    code = "import {}, sys; print(*sys.modules, *gymnasium.registry)".format
    of_learner = "gymnasium; from sb3_hds import TD7, TQC, DroQ, load_policy; import sb3_hds"
    bare, ours, learner = (
        set(succeeds(sys.executable, "-c", code(package)).split())
        for package in ("gymnasium", "gymnasium, sb3_hds", of_learner)
    )

    modules = {name for name in ours - bare if not name.startswith("sb3_hds/")}
    assert {name for name in modules if name.split(".")[0] not in sys.stdlib_module_names} == {
        *("sb3_hds", "sb3_hds.algos", "sb3_hds.algos.registry", "sb3_hds.lazy"),
        *("sb3_hds.envs", "sb3_hds.envs.registration"),
    }
    assert "sb3_hds/CartPoleSwingUp-v0" in ours
    assert {"cmaes", "sb3_hds.sysid", "sb3_hds.twins"} & learner == set()


def test_public_names_are_listed_and_exist():
    import sb3_hds

    assert set(sb3_hds.__all__) <= set(dir(sb3_hds))
    for name in sb3_hds.__all__:
        assert getattr(sb3_hds, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'HSD'"):
        sb3_hds.HSD  # noqa: B018
