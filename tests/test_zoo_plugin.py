"""The parts of ``rl_zoo_plugin``: hook, stand-ins, samplers and files."""

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest
import yaml
from cases import each
from small_models import small

import sb3_hds
from rl_zoo_plugin import __main__, callbacks, hook, lazy, samplers, tables, trials
from rl_zoo_plugin.lazy import LazyAlgorithm
from rl_zoo_plugin.samplers import SAMPLERS
from sb3_hds.algos.registry import ALGORITHMS

STOCK = {"a2c", "ars", "crossq", "ddpg", "dqn", "ppo", "ppo_lstm", "qrdqn", "sac", "td3", "tqc"}
USUAL = {"Pendulum-v1", "MountainCarContinuous-v0", "InvertedPendulum-v5", "Hopper-v5"}
USUAL |= {"HalfCheetah-v5", "Ant-v5", "Walker2d-v5", "Swimmer-v5"}
# Keys of a zoo entry that the zoo itself consumes, see ExperimentManager._preprocess_hyperparams.
CONSUMED_BY_THE_ZOO = {"n_timesteps", "n_envs", "normalize", "env_wrapper", "frame_stack"}
CONSUMED_BY_THE_ZOO |= {"noise_type", "noise_std"}
# What papers, or their authors' code where these are silent, have on Hopper-v5.
PUBLISHED = {
    # Configs of DAVIAN-Robotics/SimbaV2.
    "simba": {"gamma": 0.995, "clipped_double_q": None, "learning_rate": 1e-4},
    # Hiraoka et al. 2022, appendix.
    "droq": {"learning_starts": 5000, "target_entropy": -1.0},
    # SamsungLabs/tqc_pytorch, main.py: training begins with the first full batch.
    "tqc_jax": {"learning_starts": 256, "top_quantiles_to_drop_per_net": 5},
}


class Walker:
    """Stands for an algorithm."""

    answer = 42

    def __init__(self, policy, env=None, stride=0.5, _init_setup_model=True):
        self.stride = stride

    @classmethod
    def load(cls, path, env=None, custom_objects=None, **kwargs):
        return cls("MlpPolicy", env, **kwargs)


@pytest.fixture
def walker(monkeypatch) -> LazyAlgorithm:
    monkeypatch.setattr(sb3_hds, "Walker", Walker, raising=False)
    return LazyAlgorithm("Walker")


def load_yml(algo: str) -> dict:
    return yaml.safe_load(tables.hyperparams_file(algo).read_text())


def test_a_stand_in_is_called_loaded_and_read_like_the_class(walker):
    assert walker.__name__ == "Walker" and walker("MlpPolicy", stride=0.7).stride == 0.7
    assert walker.load("agent.zip", custom_objects={}, stride=0.7).stride == 0.7
    # A single argument of the policy is not asked for when one is loaded.
    assert walker.load("agent.zip", **{"policy_kwargs.net_arch": [4]}).stride == 0.5
    assert walker.answer == 42 and not hasattr(walker, "__wrapped__")
    for mistaken in (lambda: walker("MlpPolicy", strid=0.7), lambda: walker.load("a", strid=0.7)):
        with pytest.raises(TypeError, match=r"no hyperparameter 'strid'. Did you mean 'stride'\?"):
            mistaken()


def test_an_algorithm_is_known_to_the_zoo_unless_its_id_is_taken():
    zoo = SimpleNamespace(ALGOS={"hds": "somebody else's"})

    tables.EXTENSIONS["rl_zoo3.utils"](zoo)

    assert zoo.ALGOS["hds"] == "somebody else's"
    assert isinstance(zoo.ALGOS["pods"], LazyAlgorithm)
    assert not set(ALGORITHMS) & STOCK


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_a_yml_file_has_published_settings_for_every_environment_that_it_is_meant_for(algo):
    algorithm, entries = LazyAlgorithm(ALGORITHMS[algo].name).resolve(), load_yml(algo)
    known = set(lazy.parameters_of(algorithm)) | CONSUMED_BY_THE_ZOO
    environments = sb3_hds.twins.all_ids() if algo in ("pods", "hds") else USUAL

    # DroQ's paper has a target entropy for Humanoid.
    assert {*environments, "default"} == set(entries) - {"Humanoid-v5"}
    for env_id, entry in entries.items():
        assert entry["n_timesteps"] > 0 and set(entry) <= known, env_id
    published = PUBLISHED.get(algo, {})
    assert {name: entries["Hopper-v5"].get(name) for name in published} == published


@pytest.fixture
def study():
    optuna = pytest.importorskip("optuna")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_a_trial_is_recreated_exactly_has_arguments_and_steps_left_to_learn_from(algo, study):
    algorithm = LazyAlgorithm(ALGORITHMS[algo].name).resolve()
    known = set(lazy.parameters_of(algorithm))
    of_policies = set(lazy.parameters_of(algorithm.policy_aliases["MlpPolicy"]))
    sampler = SAMPLERS[ALGORITHMS[algo].sampler]

    for i in range(8):
        trial, n_timesteps = study.ask(), (50, 20_000)[i % 2]
        with trials.running(0, n_timesteps):
            sampled = sampler(trial, n_actions=1, n_envs=1 + i // 2 % 2, additional_args={})
        study.tell(trial, 0.0)
        assert sampler.convert(study.trials[-1].params) == sampled
        # The zoo writes them to config.yml, which has to be readable without this package.
        assert yaml.safe_load(yaml.safe_dump(sampled)) == sampled
        arguments, of_policy = lazy._split(sampled)
        assert set(arguments) <= known and set(of_policy) <= of_policies
        n_dropped = sampled.get("top_quantiles_to_drop_per_net", 0)
        assert 0 <= n_dropped < sampled.get("policy_kwargs.n_quantiles", 1 + n_dropped)
        assert 0 <= sampled.get("learning_starts", 0) <= n_timesteps / 4
        # TD7 updates as often as it has acted, unless it acts in several environments.
        assert algo != "td7" or ("gradient_steps" in sampled) == (i // 2 % 2 == 1)
        # A generation of OpenLoop, where the steps are enough for a few small ones.
        horizon = sampled.get("horizon") or 1_000
        in_one = horizon * sampled.get("n_resets", 1) * sampled.get("population_size", 1)
        assert in_one <= max(n_timesteps / 5, 8 * horizon)


@pytest.mark.parametrize("algo", ["gsde_sac", "crossq_jax", "droq", "tqc_jax", "bro", "td7"])
def test_what_is_sampled_goes_with_what_the_file_says_of_the_policy(algo, study, monkeypatch):
    narrow = {"pi": [8], "qf": [8, 8]}
    monkeypatch.setattr(samplers, "_NET_ARCHS", {a: [8, 8] for a in samplers._NET_ARCHS})
    monkeypatch.setattr(samplers, "_BLOCKS", {a: narrow for a in samplers._BLOCKS})
    entry = load_yml(algo)["HalfCheetah-v5"]
    given = {name: entry[name] for name in ("policy", "policy_kwargs") if name in entry}

    with trials.running(0, 40):
        # The zoo updates the one with the other.
        given |= SAMPLERS[ALGORITHMS[algo].sampler](
            study.ask(), n_actions=1, n_envs=1, additional_args={}
        )
        model = LazyAlgorithm(ALGORITHMS[algo].name)(env="Pendulum-v1", **given)

    assert model.policy_kwargs["net_arch"] == (narrow if algo == "bro" else [8, 8])
    if algo == "tqc_jax":
        assert model.policy.update_config.n_critics == entry["policy_kwargs"]["n_critics"] == 5


def test_a_trial_has_memory_for_its_own_steps_alone():
    algorithm = LazyAlgorithm("DroQ")

    with trials.running(3, 400):
        in_trial = algorithm(env="Pendulum-v1", learning_starts=5_000)
        smaller = algorithm(env="Pendulum-v1", buffer_size=50, learning_starts=7)

    assert (in_trial.buffer_size, in_trial.learning_starts) == (400, 100)
    assert (smaller.buffer_size, smaller.learning_starts) == (50, 7)


def test_a_trial_says_now_and_then_how_far_it_is(capsys, monkeypatch):
    monkeypatch.setattr(callbacks, "_PROGRESS_INTERVAL", 0.0)
    with trials.running(3, 20):
        progress = callbacks.TrialProgress()
    small("droq", learning_starts=100).learn(25, callback=progress)
    progress.locals["pretraining"] = True
    progress.on_step()

    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("Trial 3: 0 of 25 steps after 0 s")
    assert lines[-2].startswith("Trial 3: 25 of 25 steps after")
    assert "Trial 3: planning before the first step after" in lines[-1]


class Manager:
    """Stands for the zoo's ``ExperimentManager``."""

    def __init__(self, algo, config=None, show_progress=False, n_jobs=1):
        self.algo, self.n_timesteps, self.specified_callbacks = algo, 500, ["theirs.Callback"]
        self.show_progress, self.n_jobs = show_progress, n_jobs
        self.storage = self.study_name = None

    def objective(self, trial):
        return trials.budget()

    def hyperparameters_optimization(self):
        self.found = self.objective(SimpleNamespace(number=3))


@each(
    ({"show_progress": True}, "stable_baselines3.common.callbacks.ProgressBarCallback"),
    ({"show_progress": True, "n_jobs": 2}, "rl_zoo_plugin.callbacks.TrialProgress"),
)
def test_trials_of_ours_know_their_steps_and_show_where_they_are(given, shown, monkeypatch):
    manager = type("Manager", (Manager,), dict(vars(Manager)))
    zoo = SimpleNamespace(ALGOS={"hds": LazyAlgorithm("HDS"), "sac": object})
    zoo.ExperimentManager = manager
    tables.EXTENSIONS["rl_zoo3.exp_manager"](zoo)
    ours, stock = manager("hds", **given), manager("sac", **given)

    ours.hyperparameters_optimization()
    stock.hyperparameters_optimization()

    assert ours.found == (3, 500) and trials.budget() is None
    assert ours.specified_callbacks == ["theirs.Callback", shown]
    assert stock.found is None and stock.specified_callbacks == ["theirs.Callback"]


def test_the_hook_is_switched_off_by_a_variable_and_the_module_names_its_commands(monkeypatch):
    monkeypatch.setenv("SB3_HDS_NO_ZOO", "1")
    with monkeypatch.context() as here:
        here.setattr(sys, "meta_path", [])
        hook.start()
        assert sys.meta_path == []

    monkeypatch.setattr(sys, "argv", ["rl_zoo_plugin", "trian"])
    with pytest.raises(SystemExit, match="Unknown command 'trian'"):
        __main__.main()


def test_a_broken_extension_leaves_the_zoo_usable_and_says_so(monkeypatch):
    def breaks(module):
        raise KeyError("ALGOS")

    monkeypatch.setitem(tables.EXTENSIONS, "rl_zoo3.utils", breaks)

    with pytest.warns(RuntimeWarning, match=r"could not extend rl_zoo3\.utils: KeyError"):
        hook._extend(SimpleNamespace(__name__="rl_zoo3.utils"))


# The modules that the hook looks for, and what of them is extended.
FAKE_ZOO = {
    "__init__": "from rl_zoo3.utils import ALGOS",
    "utils": "ALGOS = {'sac': 'stock'}",
    "hyperparams_opt": "HYPERPARAMS_SAMPLER, HYPERPARAMS_CONVERTER = {}, {}",
    "exp_manager": """
from rl_zoo3.utils import ALGOS
class ExperimentManager:
    def __init__(self, args, algo, env_id, config=None):
        self.config = config
    def objective(self, trial):
        return 0.0
    def hyperparameters_optimization(self):
        pass
""",
}
PRINT_CONFIGS = """
import sys
sys.path.insert(0, {folder!r})
{before}
from rl_zoo_plugin import hook
hook.install()
hook.install()
assert [type(f).__module__ for f in sys.meta_path].count("rl_zoo_plugin.hook") == 1
from rl_zoo3.exp_manager import ALGOS, ExperimentManager
for algo, config in (("hds", None), ("hds", "mine.yml"), ("sac", None)):
    print(ExperimentManager(None, algo, "Pendulum-v1", config=config).config)
print(list(ALGOS), "jax" in sys.modules, "torch" in sys.modules)
"""


@pytest.mark.parametrize("before", ["", "import rl_zoo3.exp_manager"])
def test_a_zoo_is_extended_before_and_after_it_is_imported(tmp_path, before):
    (tmp_path / "rl_zoo3").mkdir()
    for name, source in FAKE_ZOO.items():
        (tmp_path / "rl_zoo3" / f"{name}.py").write_text(source)
    code = PRINT_CONFIGS.format(folder=str(tmp_path), before=before)
    command, environ = [sys.executable, "-c", code], os.environ | {"SB3_HDS_NO_ZOO": "1"}

    done = subprocess.run(command, env=environ, text=True, capture_output=True)

    assert done.returncode == 0, done.stderr
    ours, users, stock, names = done.stdout.splitlines()
    assert ours == str(tables.hyperparams_file("hds")) and users == "mine.yml" and stock == "None"
    # Known by name only: neither jax nor torch is imported before an algorithm is used.
    assert names == f"{['sac', *ALGORITHMS]} False False"
