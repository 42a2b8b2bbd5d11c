"""What is imported when."""

import builtins
import importlib
import subprocess
import sys
import threading

import pytest

from sb3_hds.lazy import lazy_imports, postpone

INIT = "import builtins\nbuiltins.runs_of_it.append(1)\nfrom {name}.part import VALUE\nOWN = 1\n"
#: nobody who makes a model, and learns in an exact twin, needs these
LATE = ("tensorflow_probability", "scipy.stats", "scipy.signal", "scipy.ndimage", "scipy.optimize")
LATE += ("pandas", "matplotlib", "optimistix", "mujoco", "jinja2")
IMPORTS = f"""
import sys
import jax, stable_baselines3
before = set(sys.modules)
import sb3_hds
for name in ("HDS", "DroQ", "OpenLoop"):
    getattr(sb3_hds, name)
print(sorted(set({LATE}) & (set(sys.modules) - before)))
import sbx
assert sbx.SAC.__module__ == "sbx.sac.sac" and "tensorflow_probability" in sys.modules
assert isinstance(sbx.__version__, str)
"""


@pytest.fixture
def package(tmp_path, monkeypatch, request):
    """A package that says each time that its ``__init__`` runs."""
    name = f"postponed_{abs(hash(request.node.name))}"
    folder = tmp_path / name
    folder.mkdir()
    (folder / "__init__.py").write_text(INIT.format(name=name))
    (folder / "part.py").write_text("VALUE = 3\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("builtins.runs_of_it", [], raising=False)
    yield folder
    for module in [each for each in sys.modules if each.startswith(name)]:
        del sys.modules[module]


def runs() -> int:
    return len(builtins.runs_of_it)  # type: ignore[attr-defined]


def test_a_submodule_is_imported_without_the_package_which_comes_when_it_is_asked_for(package):
    name = package.name
    postpone(name)

    part = importlib.import_module(f"{name}.part")
    assert part.VALUE == 3 and runs() == 0

    module = importlib.import_module(name)
    assert module.OWN == 1 and module.VALUE == 3 and module.part is part and runs() == 1
    postpone(name)
    assert sys.modules[name] is module and runs() == 1
    with pytest.raises(AttributeError, match="no attribute 'missing'"):
        _ = module.missing
    assert runs() == 1


def test_a_package_that_was_imported_stays(package):
    module = importlib.import_module(package.name)
    postpone(package.name)

    assert sys.modules[package.name] is module and runs() == 1


def test_a_package_that_fails_says_so_each_time(package):
    (package / "__init__.py").write_text("raise ImportError('broken')\n")
    postpone(package.name)
    module = importlib.import_module(package.name)

    for _ in range(2):
        with pytest.raises(ImportError, match="broken"):
            _ = module.OWN


def test_threads_that_read_at_the_same_time_find_it_complete(package):
    source = INIT.format(name=package.name)
    (package / "__init__.py").write_text(f"import time\n{source}time.sleep(0.3)\nLAST = 2\n")
    postpone(package.name)
    module, found = importlib.import_module(package.name), []

    asking = [threading.Thread(target=lambda: found.append(module.LAST)) for _ in range(4)]
    for thread in asking:
        thread.start()
    for thread in asking:
        thread.join()

    assert found == [2] * 4 and runs() == 1


def test_imports_in_a_block_are_made_on_first_use_of_their_names(package):
    """``part`` is the name of a submodule and of something in it."""
    name, usual = package.name, builtins.__import__
    (package / "__init__.py").write_text(
        f"from sb3_hds.lazy import lazy_imports\n"
        f"with lazy_imports(__name__):\n    from {name}.part import VALUE, part\n"
    )
    (package / "part.py").write_text("VALUE, part = 3, 'a name'\n")

    module = importlib.import_module(name)

    assert builtins.__import__ is usual and f"{name}.part" not in sys.modules
    assert module.VALUE == 3 and f"{name}.part" in sys.modules
    assert module.part == "a name" and dir(module) == ["VALUE", "part"]
    with pytest.raises(AttributeError, match="no attribute 'missing'"):
        _ = module.missing


def test_other_modules_import_as_usual_during_a_block(package):
    module = importlib.import_module(package.name)
    with lazy_imports(package.name):
        assert __import__("json", fromlist=["dumps"]).dumps(1) == "1"

    assert builtins.__import__.__name__ == "__import__" and dir(module) == []


def test_what_is_not_there_is_not_put_there():
    postpone("no_such_package_of_that_name")

    assert "no_such_package_of_that_name" not in sys.modules


def test_algorithms_import_only_what_they_need_and_sbx_stays_complete():
    done = subprocess.run([sys.executable, "-c", IMPORTS], text=True, capture_output=True)

    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["[]"]
