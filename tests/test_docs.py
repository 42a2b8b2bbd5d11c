"""What the pages of the documentation show works, and what they generate is what the code is."""

import ast
import inspect
import pydoc
import re
import shlex
import subprocess
import sys
import tomllib
from importlib.util import find_spec
from pathlib import Path

import gymnasium
import pytest
import yaml

from rl_zoo_plugin.lazy import OF_POLICY, parameters_of
from rl_zoo_plugin.tables import ALGORITHMS
from sb3_hds import HDS, PODS, algos, cli, effects, twins
from sb3_hds.algos.log import record_epoch
from sb3_hds.envs.registration import HARDWARE, STEP_LIMITS, TASKS

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
sys.path.insert(0, str(DOCS / "extensions"))

import benchmark_results  # noqa: E402
import catalogue  # noqa: E402
import import_picture  # noqa: E402
import summaries  # noqa: E402

pytestmark = pytest.mark.usefixtures("quick_compilation")

PAGES = sorted([*DOCS.glob("*.md"), *DOCS.glob("[!_]*/[!_]*.md"), ROOT / "README.md"])

SCRIPTS = sorted((ROOT / "benchmarks").glob("*.py"))

# The pages show the defaults that a user wants; here it is enough that the code runs.
SMALL = {
    "pretrain_epochs": 2,
    "n_rollouts": 4,
    "horizon": 4,
    "lookahead": 0,
    "gradient_steps": 2,
    "n_iterations": 1,
    "n_random_plans": 0,
    "order": 1,
    "terminal_value": False,
    "train_freq": 1000,
}
SMALL_HDS = {"residual": False, "replan_epochs": 1}

_FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_PLACEHOLDER = re.compile(r"<[^>]*>")


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def blocks(page: Path, language: str) -> list[str]:
    """The code of a page, on the lines where it stands, so that tracebacks point there."""
    text = page.read_text()
    found = [match for match in _FENCE.finditer(text) if match[1] == language]
    return ["\n" * text.count("\n", 0, match.start(2)) + match[2] for match in found]


# Their code learns from data, for minutes.
LONG = ("docs/guide/measured.md", "docs/guide/diagnose.md")


def commands(page: Path) -> list[list[str]]:
    """Every command of a page as its words, without comments and environment variables."""
    script = "".join(block.lstrip("\n") for block in blocks(page, "bash"))
    lines = _PLACEHOLDER.sub("PLACE", script).replace("\\\n", " ").splitlines()
    words = [shlex.split(part, comments=True) for line in lines for part in line.split("&&")]
    assignment = re.compile(r"\w+=\S*")
    return [[w for w in part if not assignment.fullmatch(w)] or part for part in words if part]


@pytest.fixture
def small_and_tidy(monkeypatch, tmp_path):
    """Small plans, a folder to write in, and registries that forget what a page registered."""
    for algorithm in (HDS, PODS):
        for name, value in (SMALL | (SMALL_HDS if algorithm is HDS else {})).items():
            monkeypatch.setitem(algorithm.__init__.__kwdefaults__, name, value)
        monkeypatch.setattr(algorithm, "default_timesteps", 20)
    monkeypatch.setattr(twins.registry, "_TWINS", dict(twins.registry._TWINS))
    known = set(gymnasium.registry)
    monkeypatch.chdir(tmp_path)
    yield
    for env_id in set(gymnasium.registry) - known:
        del gymnasium.registry[env_id]


# Their blocks of text are what their code prints.
PRINTED = ("docs/modules/task_design.md",)


def shown_in(script: Path) -> list[list[str]]:
    """The commands in the docstring of a benchmark, as words."""
    text = ast.get_docstring(ast.parse(script.read_text())) or ""
    lines = [line.partition("  #")[0].strip() for line in text.splitlines()]
    return [shlex.split(line) for line in lines if line.startswith("python benchmarks/")]


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=pytest.mark.expensive if name_of(page) in LONG else ())
        for page in PAGES
        if blocks(page, "python")
    ],
    ids=lambda page: name_of(page),
)
def test_the_code_of_a_page_runs_from_top_to_bottom(page, small_and_tidy, capsys):
    namespace = {"__name__": "a_page"}

    for code in blocks(page, "python"):
        exec(compile(code, str(page), "exec"), namespace)

    said, shown = capsys.readouterr().out, blocks(page, "text")
    for paragraph in "".join(shown).split("\n\n") if name_of(page) in PRINTED else ():
        assert paragraph.strip() in said


def test_commands_that_are_shown_exist_with_their_options_and_others_are_found():
    of_pages = {name_of(page): commands(page) for page in PAGES}
    of_scripts = {script.name: shown_in(script) for script in SCRIPTS}
    wrong = {
        (place, " ".join(words)): told
        for place, each in (of_pages | of_scripts).items()
        for words in each
        if (told := objection(words))
    }
    mistaken = (
        "make instal",
        "pip install sb3-hds[zo]",
        "rl_zoo3 trian --algo hds",
        "rl_zoo3 train --algo hds --evaluate-freq 5",
        "rl_zoo3 train --algo tqc_jax -params policy_kwargs.n_critic:5",
        "python benchmarks/nothing.py",
        "sb3-hds diagnose --twin PendulumReal",
        "rm -rf everything",
    )

    assert wrong == {}
    assert [line for line in mistaken if objection(line.split()) is None] == []


def test_hyperparameters_that_are_shown_are_arguments_of_the_algorithms():
    own = {"n_timesteps", "n_envs", "normalize", "env_wrapper"}  # of the zoo itself
    read = [yaml.safe_load(block) for page in PAGES for block in blocks(page, "yaml")]
    for entry in (entry for each in read for entry in each.values()):
        for wrapper in entry.get("env_wrapper", ()):
            [(path, arguments)] = wrapper.items()
            known = inspect.signature(pydoc.locate(path)).parameters
            assert set(arguments) <= set(known)
        assert set(entry) - own <= set(inspect.signature(HDS).parameters)


def test_an_own_twin_takes_less_than_40_lines():
    [code] = [b for b in blocks(DOCS / "guide/own_twin.md", "python") if "@twins.register" in b]

    assert len([line for line in code.splitlines() if line.strip()]) < 40


def test_every_argument_and_every_logged_value_of_an_algorithm_is_documented():
    logged = (DOCS / "modules/_logged.md").read_text()
    source = inspect.getsource(record_epoch)

    for key in re.findall(r'record\("([a-z_/]+)"', source):
        assert f"`{key}`" in logged
    for algorithm in algos.ALL.values():
        documented = [base.__doc__ or "" for base in algorithm.__mro__]
        for name in parameters_of(algorithm):
            assert name == "self" or any(f":param {name}:" in text for text in documented)


def test_every_algorithm_has_a_page_in_the_template_of_sb3():
    template = ("Notes", "Example", "Results", "How to replicate", "Parameters")

    for algo, algorithm in algos.ALL.items():
        text = (DOCS / f"modules/{algo}.md").read_text()
        assert [title for title in template if f"\n## {title}\n" not in text] == []
        assert f"autoclass:: sb3_hds.{algorithm.__name__}\n" in text


def test_every_twin_effect_and_environment_is_listed_with_its_parameters():
    shown = catalogue.twins_as_markdown()
    for name in [*twins.names()]:
        section = shown.partition(f"\n## {name}\n")[2].partition("\n## ")[0]
        twin = twins.make(name)
        named = [*twin.parameters, *(s.name for s in (*twin.actuators, *twin.channels))]
        assert [n for n in (*named, *twin.options) if f"`{n}`" not in section] == []

    shown = catalogue.effects_as_markdown()
    for effect in effects.ALL:
        for name, parameter in effect.parameters.items():
            assert f"`{name}` [{parameter.unit}]" in shown and effect.explanation in shown

    listed = catalogue.environments_as_markdown()
    assert [i for i in STEP_LIMITS | HARDWARE | TASKS if f"`{i}`" not in listed] == []


def test_a_surrogate_is_announced_where_planning_maximises_something_else():
    rows = [line for line in catalogue.surrogates_as_markdown().splitlines() if "`" in line]
    lines = {line.split("`")[1]: line for line in rows}

    # By their definitions: Pendulum-v1's cost is smooth, InvertedPendulum-v5 pays for being alive.
    assert "the reward itself" in lines["Pendulum"]
    assert "flat" in lines["InvertedPendulum"] and "surrogate" in lines["InvertedPendulum"]


def test_the_picture_shows_the_imports_that_are_there_and_its_arrows_point_down(tmp_path):
    files = {
        "sb3_hds/__init__.py": '"""The root."""\nfrom sb3_hds.algos import HDS',
        "sb3_hds/errors.py": '"""Errors: of all kinds."""',
        "sb3_hds/core/__init__.py": '"""The core."""\nimport jax.numpy\nimport sb3_hds.errors',
        "sb3_hds/algos/__init__.py": "",
        "sb3_hds/algos/hds.py": "def f():\n    from sb3_hds import core\n    import sb3_hds.errors",
        "rl_zoo_plugin/__init__.py": "import sb3_hds, os",
    }
    for path, source in files.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(source)

    layers = import_picture.read(tmp_path)

    imports = {name: set(layer.layers) for name, layer in layers.items()}
    assert (imports["errors"], imports["core"]) == (set(), {"errors"})
    assert imports["algos"] == {"core", "errors"} and imports["rl_zoo_plugin"] == {"sb3_hds"}
    assert layers["core"].libraries == {"jax"} and layers["errors"].summary.startswith("Errors")
    # The way from algos to errors leads through core.
    assert import_picture.without_detours(imports)["algos"] == {"core"}
    svg = import_picture.as_svg(layers)
    assert svg.count("<rect") == 5 and svg.count("marker-end") == 4
    ours = {name: layer.layers for name, layer in import_picture.read().items()}
    order = import_picture.ranks(ours)
    assert all(order[name] > order[below] for name in ours for below in ours[name])


def test_results_are_shown_with_the_command_that_made_them(tmp_path):
    assert re.search(r"\d", benchmark_results.as_markdown(tmp_path)) is None
    (tmp_path / "results").mkdir()
    script = '"""Regret on a pendulum."""\nif __name__ == "__main__":\n    pass'
    (tmp_path / "pendulum.py").write_text(script)
    (tmp_path / "results/regret.csv").write_text("algorithm,regret\nhds,1.5\n")

    shown = benchmark_results.as_markdown(tmp_path)

    assert "pendulum.py`" in shown and "Regret on a pendulum." in shown
    assert "| hds | 1.5 |" in shown and "### regret" in shown


def test_the_share_of_a_gap_is_shown_once_both_of_its_ends_were_measured(tmp_path, monkeypatch):
    monkeypatch.setattr(summaries, "RESULTS", tmp_path)
    shown = summaries.over_seeds("t", "variant", "return", ends=("t", "worst", "best"))
    rows = "variant,seed,return\nhalf,0,5\nhalf,1,15\nworst,0,0\nworst,1,10\n"

    (tmp_path / "t.csv").write_text(rows)
    assert "| half | 10 (5 to 15) | 2 |" in shown()

    (tmp_path / "t.csv").write_text(rows + "best,0,10\n")
    assert "| half | 10 (5 to 15) | 0.5 | 2 |" in shown()
    (tmp_path / "t.csv").write_text(rows + "best,0,10\nbest,1,30\n")
    # Gained 5 and 5, of 10 and 20.
    assert "| half | 10 (5 to 15) | 0.333 | 2 |" in shown()


def test_results_are_turned_into_the_tables_of_the_pages(tmp_path, monkeypatch):
    monkeypatch.setattr(summaries, "RESULTS", tmp_path)
    turned = summaries.crossed("shares", ("kind",), ("env", "policy"), "share")
    assert turned() == summaries.gaits() == "Not measured yet in this checkout.\n\n"
    rows = "kind,env,policy,seed,share\npush,A,gait,0,0.2\npush,A,gait,1,0.4\nnoise,B,sac,0,1\n"
    found = "env,steps,return,target,searched,seconds\n"
    found += "".join(f"A,200000,{value},290,7,120\n" for value in (1, 5, 3000))
    minutes = "minutes,steps,return,late\n1,200,-9,3\n2,400,-2,3\n3,600,-4,5\n"
    for name, table in (("shares", rows), ("open_loop", found), ("minutes", minutes)):
        (tmp_path / f"{name}.csv").write_text(table)
    (tmp_path / "shares.png").touch()

    shown = turned()

    assert "| kind | A, gait | B, sac |" in shown and "shares.png)" in shown
    assert "| push | 0.3 |  |" in shown and "| noise |  | 1 |" in shown
    assert "| A | 200,000 | 7 | 5 (1 to 3,000) | 290 | 3 | 2 |" in summaries.gaits()
    assert "| 2 to 3 | 3 | -3 (-4 to -2) | 2 |" in summaries.first_and_rest("minutes", 1)()


@pytest.mark.expensive
@pytest.mark.skipif(find_spec("sphinx") is None, reason="needs the extra 'dev'")
def test_the_documentation_builds_without_warnings(tmp_path):
    sphinx = (sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html")

    done = subprocess.run([*sphinx, DOCS, tmp_path], text=True, capture_output=True)

    assert done.returncode == 0, done.stderr


def objection(words: list[str]) -> str | None:
    """What is wrong with a command, if anything."""
    match words:
        case ["make", *targets]:
            makefile = (ROOT / "Makefile").read_text()
            known = set(re.findall(r"^([\w-]+):", makefile, re.MULTILINE))
            return _missing("target", [t for t in targets if "=" not in t], known)
        case ["pip", "install", *packages]:
            return _unknown_packages(packages)
        case ["rl_zoo3", command, *options] | ["python", "-m", "rl_zoo_plugin", command, *options]:
            return _wrong_zoo_command(command, options)
        case ["python", "-m", module, *options] if module.startswith("rl_zoo3."):
            return _wrong_zoo_command(module.removeprefix("rl_zoo3."), options)
        case ["sb3-hds", *options]:
            try:
                cli.parser().parse_args(options)
            except SystemExit as end:
                if end.code == 0:
                    return None
                return f"sb3-hds does not take {' '.join(options)}"
            return None
        case ["python", script, *options]:
            if not (ROOT / script).is_file():
                return f"no script {script}"
            return _missing("option", _options(options), _declared_options(ROOT / script))
        case ["git", "clone", *_] | ["cd", _]:
            return None
    return f"unknown command {words[0]}"


def _missing(kind: str, shown: list[str], known: set[str]) -> str | None:
    missing = sorted(set(shown) - known)
    return f"no {kind} {missing}" if missing else None


def _unknown_packages(words: list[str]) -> str | None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for word in words:
        name, _, extras = word.partition("[")
        extra = {e for e in extras.rstrip("]").split(",") if e}
        if name in ("sb3-hds", ".") and not extra <= set(project["optional-dependencies"]):
            return f"no extra {extra}"
        if name not in (project["name"], ".", "torch") and not word.startswith(("-", "http")):
            return f"unknown package {name}"
    return None


def _wrong_zoo_command(command: str, words: list[str]) -> str | None:
    spec = find_spec("rl_zoo3")
    if spec is None:
        pytest.skip("needs the extra 'zoo'")
    package = Path(spec.origin).parent
    script = next(package.glob(f"**/{command}.py"), None)
    if script is None:
        return f"no command {command}"
    wrong = _missing("option", _options(words), _declared_options(script))
    algo = words[words.index("--algo") + 1] if "--algo" in words else "hds"
    params = words[words.index("-params") + 1 :] if "-params" in words else []
    known = {*parameters_of(algos.ALL.get(algo, HDS)), "n_envs", *_policy_keys(algo)}
    keys = [word.partition(":")[0] for word in params if not word.startswith("-")]
    return (
        wrong
        or _missing("algorithm", [algo], {*ALGORITHMS, "sac"})
        or _missing("hyperparameter", keys, known)
    )


def _policy_keys(algo: str) -> set[str]:
    """Keys of single arguments of the policy of one of ours."""
    if algo not in algos.ALL:
        return set()
    return {OF_POLICY + name for name in parameters_of(algos.ALL[algo].policy_aliases["MlpPolicy"])}


def _options(words: list[str]) -> list[str]:
    return [word for word in words if word.startswith("-")]


def _declared_options(script: Path) -> set[str]:
    """The options that a script's calls of ``add_argument`` name, read without running it."""
    return {
        str(word.value)
        for call in ast.walk(ast.parse(script.read_text()))
        if isinstance(call, ast.Call) and getattr(call.func, "attr", None) == "add_argument"
        for word in call.args
        if isinstance(word, ast.Constant)
    }
