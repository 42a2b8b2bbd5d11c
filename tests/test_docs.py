"""Code and commands on the pages of the documentation work, and generated parts match the code."""

import ast
import inspect
import os
import pydoc
import re
import shlex
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import gymnasium
import pytest
import yaml

from rl_zoo_plugin.lazy import OF_POLICY, parameters_of
from sb3_hds import HDS, PODS, algos, cli, effects, twins
from sb3_hds.algos.registry import ALGORITHMS
from sb3_hds.algos.twin.config import Refinements
from sb3_hds.algos.twin.epoch import epoch_log
from sb3_hds.envs.registration import HARDWARE, STEP_LIMITS, TASKS

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
sys.path[:0] = [str(DOCS / "extensions"), str(ROOT / "examples")]

import catalogue  # noqa: E402
import demo_diagnosis  # noqa: E402
import reference  # noqa: E402

PAGES = sorted([*DOCS.glob("*.md"), *DOCS.glob("[!_]*/[!_]*.md"), ROOT / "README.md"])

# Pages show the defaults that a user wants; here the code only has to run.
SMALL = dict.fromkeys(("pretrain_epochs", "lookahead", "gradient_steps", "n_random_plans"), 0)
SMALL |= {"n_rollouts": 4, "horizon": 4, "planner": "first_order", "train_freq": 200}
SMALL |= {"terminal_value": False}
SMALL_HDS = {"beta": 0.0}
PLANNING = {"pretrain_epochs": 1, "gradient_steps": 2, "train_freq": 1_000}

# Their code learns from data, for minutes.
LONG = ("README.md", "docs/index.md", "docs/guide/measured.md", "docs/guide/diagnose.md")
# Their code reads published logs, which are not part of the repository.
ON_MEASURED_DATA = {"docs/guide/from_logs_to_policy.md": "bam_xl330"}
# Their code is DroQ's but for names.
LIKE_DROQ = ("bro", "crossq_jax", "gsde_sac", "simba", "td7")

_FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_PLACEHOLDER = re.compile(r"<[^>]*>")


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def blocks(page: Path, language: str) -> list[str]:
    """The code of a page at its original line numbers, so that tracebacks are right."""
    text = page.read_text()
    found = [match for match in _FENCE.finditer(text) if match[1] == language]
    return ["\n" * text.count("\n", 0, match.start(2)) + match[2] for match in found]


def commands(page: Path) -> list[list[str]]:
    """Every command of a page as its words, without comments and environment variables."""
    script = "".join(block.lstrip("\n") for block in blocks(page, "bash"))
    lines = _PLACEHOLDER.sub("PLACE", script).replace("\\\n", " ").splitlines()
    words = [shlex.split(part, comments=True) for line in lines for part in line.split("&&")]
    assignment = re.compile(r"\w+=\S*")
    return [[w for w in part if not assignment.fullmatch(w)] or part for part in words if part]


def set_default(monkeypatch, config, name, value):
    monkeypatch.setitem(config.__init__.__kwdefaults__, name, value)


@pytest.fixture
def small_and_tidy(monkeypatch, tmp_path):
    """Small plans, a folder to write in, and registries that forget what a page registered."""
    for algorithm in (HDS, PODS):
        for name, value in (SMALL | (SMALL_HDS if algorithm is HDS else {})).items():
            set_default(monkeypatch, algorithm.config_class, name, value)
        monkeypatch.setattr(algorithm, "default_timesteps", 20)
    set_default(monkeypatch, Refinements, "n_iterations", 1)
    monkeypatch.setattr("sb3_hds.algos.twin.hds.algorithm._REPLAN_EPOCHS", 1)
    monkeypatch.setattr(twins.registry, "_TWINS", dict(twins.registry._TWINS))
    known = set(gymnasium.registry)
    monkeypatch.chdir(tmp_path)
    yield
    for env_id in set(gymnasium.registry) - known:
        del gymnasium.registry[env_id]


def marks_of(page: Path) -> tuple[pytest.MarkDecorator, ...]:
    if name_of(page) in ON_MEASURED_DATA:
        absent = "SB3_HDS_DATA" not in os.environ
        skip = pytest.mark.skipif(absent, reason="data outside the repository")
        return pytest.mark.measured, pytest.mark.expensive, skip
    return (pytest.mark.expensive,) if name_of(page) in LONG else ()


def prepare_files(page: Path) -> None:
    """Put what the code of a page reads into the current folder."""
    if name_of(page) == "docs/index.md":
        demo_diagnosis.record(Path("log.jsonl"))
    if data := ON_MEASURED_DATA.get(name_of(page)):
        Path("logs").symlink_to(Path(os.environ["SB3_HDS_DATA"], data))


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=marks_of(page))
        for page in PAGES
        if blocks(page, "python") and page.stem not in LIKE_DROQ
    ],
    ids=lambda page: name_of(page),
)
def test_the_code_of_a_page_runs_from_top_to_bottom(page, small_and_tidy, capsys, monkeypatch):
    namespace = {"__name__": "a_page"}
    prepare_files(page)
    if page.stem in ("hds", "measured"):  # the others act without having planned
        for name, value in PLANNING.items():
            set_default(monkeypatch, HDS.config_class, name, value)

    for code in blocks(page, "python"):
        exec(compile(code, str(page), "exec"), namespace)

    said, shown = capsys.readouterr().out, blocks(page, "text")
    # Its blocks of text are what its code prints.
    is_printed = page.stem == "task_design"
    for paragraph in "".join(shown).split("\n\n") if is_printed else ():
        assert paragraph.strip() in said


def test_commands_that_are_shown_exist_with_their_options_and_others_are_found():
    wrong = {
        (name_of(page), " ".join(words)): told
        for page in PAGES
        for words in commands(page)
        if (told := objection(words))
    }
    mistaken = (
        "make instal",
        "rl_zoo3 train --algo hds --evaluate-freq 5",
        "rl_zoo3 train --algo tqc_jax -params policy_kwargs.n_critic:5",
        "sb3-hds diagnose --twin PendulumReal",
    )

    assert wrong == {} and [line for line in mistaken if objection(line.split()) is None] == []


def test_hyperparameters_that_are_shown_are_arguments_of_the_algorithms():
    own = {"n_timesteps", "n_envs", "normalize", "env_wrapper"}  # of the zoo itself
    read = [yaml.safe_load(block) for page in PAGES for block in blocks(page, "yaml")]
    for entry in (entry for each in read for entry in each.values()):
        for wrapper in entry.get("env_wrapper", ()):
            [(path, arguments)] = wrapper.items()
            known = inspect.signature(pydoc.locate(path)).parameters
            assert set(arguments) <= set(known)
        assert set(entry) - own <= set(inspect.signature(HDS).parameters)


def test_every_argument_and_every_logged_value_is_documented_on_pages_in_the_template_of_sb3():
    logged, source = (DOCS / "modules/_logged.md").read_text(), inspect.getsource(epoch_log)
    assert [k for k in re.findall(r'"([a-z_]+/[a-z_]+)"', source) if f"`{k}`" not in logged] == []
    template = ("Notes", "Example", "Results", "How to replicate", "Parameters")
    [of_droq] = blocks(DOCS / "modules/droq.md", "python")

    for algo, algorithm in algos.ALL.items():
        page = DOCS / f"modules/{algo}.md"
        text, documented = page.read_text(), algorithm.__init__.__doc__
        assert [title for title in template if f"\n## {title}\n" not in text] == []
        assert f"autoclass:: sb3_hds.{algorithm.__name__}\n" in text
        assert [n for n in parameters_of(algorithm) if f":param {n}:" not in documented] == []
        if algo in LIKE_DROQ:
            [code] = blocks(page, "python")
            own = of_droq.replace("DroQ", algorithm.__name__).replace("droq", algo)
            assert code.strip() == own.strip()


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


def test_every_public_name_is_in_the_reference():
    listed = reference.as_markdown()
    for package in reference.PACKAGES:
        names = reference.public_names(package)
        assert [n for n in names if not re.search(rf"[.`]{n}\b", listed)] == []


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
        case ["rl_zoo3", command, *options] | ["python", "-m", "rl_zoo_plugin", command, *options]:
            return _wrong_zoo_command(command, options)
        case ["python", "-m", module, *options] if module.startswith("rl_zoo3."):
            return _wrong_zoo_command(module.removeprefix("rl_zoo3."), options)
        case ["sb3-hds", *options]:
            try:
                cli.parser().parse_args(options)
            except SystemExit as end:
                return f"sb3-hds does not take {' '.join(options)}" if end.code else None
            return None
        case ["python", script, *options]:
            if not (ROOT / script).is_file():
                return f"no script {script}"
            return _missing("option", _options(options), _declared_options(ROOT / script))
        case ["git", "clone" | "checkout", *_] | ["cd", _] | ["pip", "install", *_]:
            return None
        case ["kubectl", "exec", *before] if "--" in before:
            return objection(before[before.index("--") + 1 :])
        case ["ray", "start" | "stop", *_]:
            return None
        case ["sudo", "apt", "install", *_] | ["sudo", "-u", "postgres", *_]:
            return None
    return f"unknown command {words[0]}"


def _missing(kind: str, shown: list[str], known: set[str]) -> str | None:
    missing = sorted(set(shown) - known)
    return f"no {kind} {missing}" if missing else None


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
    algorithm = algos.ALL.get(algo, HDS)
    of_policy = parameters_of(algorithm.policy_aliases["MlpPolicy"])
    known = {*parameters_of(algorithm), "n_envs", *(OF_POLICY + name for name in of_policy)}
    keys = [word.partition(":")[0] for word in params if not word.startswith("-")]
    strange = _missing("algorithm", [algo], {*ALGORITHMS, "sac"})
    return wrong or strange or _missing("hyperparameter", keys, known)


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
