"""Policies on a robot: what a file computes is what the policy does."""

import json
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import onnx
import pytest
import stable_baselines3 as sb3
import torch as th
from gymnasium import spaces
from small_models import NAMES, small
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_hds import deploy
from sb3_hds.algos import GSDESAC, GaussianPolicy, OscillatorPolicy, TwinPolicy
from sb3_hds.algos.registry import load as policy_class
from sb3_hds.cli import main
from sb3_hds.core import Trajectories
from sb3_hds.deploy import OnnxPolicy, export_c, export_onnx, run_policy
from sb3_hds.deploy.c_operations import Translation
from sb3_hds.errors import ExportError
from sb3_hds.wrappers import ActionScale, CPGPrior, LowPassAction

pytestmark = pytest.mark.usefixtures("quick_compilation")

SAVED = Path(__file__).parent / "saved" / "onnx-1"
# Single precision, through two or three layers: as asserted at export.
CLOSE = 1e-5
VECTOR = spaces.Box(-np.inf, np.inf, (3,), np.float32)
PARTS = spaces.Dict(
    {
        "pose": spaces.Box(-1.0, 1.0, (2, 2), np.float32),
        "gear": spaces.Discrete(3, start=1),
        "switches": spaces.MultiDiscrete([2, 3]),
    }
)
TORQUES = spaces.Box(np.array([-2.0, 0.0], np.float32), np.array([2.0, 5.0], np.float32))

KINDS = {
    "twin": (TwinPolicy, VECTOR, {"net_arch": [8]}),
    "gaussian": (GaussianPolicy, VECTOR, {"net_arch": [8, 8], "activation_fn": "gelu_exact"}),
    "gsde": (GaussianPolicy, VECTOR, {"net_arch": [8], "use_sde": True}),
    "parts": (GaussianPolicy, PARTS, {"net_arch": [8], "activation_fn": "elu"}),
    "simba": (policy_class("SimbaPolicy"), VECTOR, {"net_arch": {"pi": [8], "qf": [8]}}),
    "crossq": (policy_class("CrossQPolicy"), VECTOR, {"net_arch": [8]}),
    "bro": (policy_class("BroPolicy"), VECTOR, {"net_arch": [8]}),
    "td7": (policy_class("TD7Policy"), VECTOR, {"net_arch": [8], "embedding_size": 8}),
}


def policy_of(kind: str):
    """Of random weights, none of them near zero, which a fresh network has in its last layer."""
    make, space, arguments = KINDS[kind]
    policy = make(space, TORQUES, lambda _: 0.0, **arguments)
    if hasattr(policy, "observed"):
        policy.update_obs_stats(drawn(space, 50, seed=3))
    rng = np.random.default_rng(1)
    state = policy.state_dict()
    for name, tensor in state.items():
        if tensor.ndim == 2:
            state[name] = tensor.new_tensor(rng.normal(0.0, 0.6, tensor.shape))
    policy.load_state_dict(state)
    return policy


def drawn(space, n: int, seed: int):
    rng = np.random.default_rng(seed)
    if not isinstance(space, spaces.Dict):
        return rng.normal(1.0, 3.0, (n, *space.shape)).astype(np.float32)
    space.seed(seed)
    rows = [space.sample() for _ in range(n)]
    return {name: np.stack([row[name] for row in rows]) for name in space.spaces}


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The file of each kind of policy, written once."""
    folder, found = tmp_path_factory.mktemp("exported"), {}

    def path_of(kind: str) -> Path:
        if kind not in found:
            found[kind] = policy_of(kind), folder / f"{kind}.onnx"
            export_onnx(*found[kind])
        return found[kind]

    return path_of


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_acts_as_its_policy_for_any_number_of_observations(kind, exported):
    policy, path = exported(kind)
    loaded = OnnxPolicy(path)

    for n in (1, 7):
        observations = drawn(policy.observation_space, n, seed=n)
        wanted, _ = policy.predict(observations, deterministic=True)
        found, state = loaded.predict(observations)
        assert np.ptp(wanted, axis=0).max() > 0.05 or n == 1  # it says something
        np.testing.assert_allclose(found, wanted, atol=2.5 * CLOSE, rtol=0.0)
        assert found.dtype == np.float32 and state is None


@pytest.mark.parametrize("kind", ["gaussian", "parts"])
def test_a_file_takes_one_observation_as_well(kind, exported):
    policy, path = exported(kind)
    rows = drawn(policy.observation_space, 1, seed=0)
    one = {k: v[0] for k, v in rows.items()} if isinstance(rows, dict) else rows[0]

    found, _ = OnnxPolicy(path).predict(one)

    np.testing.assert_allclose(found, policy.predict(one, deterministic=True)[0], atol=CLOSE)
    assert found.shape == (2,)


def test_old_runtimes_read_the_file(exported):
    # onnxruntime 1.14 has opset 18 and files of version 8; the oldest for NumPy 2 is 1.19.
    for kind in ("gaussian", "simba"):
        proto = onnx.load(exported(kind)[1])
        assert [entry.version for entry in proto.opset_import if not entry.domain] == [18]
        assert proto.ir_version <= 8
        onnx.checker.check_model(proto)


def test_a_file_says_what_it_is(exported):
    told = OnnxPolicy(exported("parts")[1]).metadata

    assert set(told["observations"]) == {
        "observation.pose",
        "observation.gear",
        "observation.switches",
    }
    assert [c["name"] for c in told["observations"]["observation.switches"]] == [
        "switches[0]",
        "switches[1]",
    ]
    assert [(a["low"], a["high"]) for a in told["actions"]] == [(-2.0, 2.0), (0.0, 5.0)]
    assert told["checked"]["n"] == 1_000 and told["checked"]["largest_error"] <= CLOSE
    assert len(told["weights_sha256"]) == 64 and "jax" in told["versions"]


def test_names_units_and_interval_are_those_of_the_twin(tmp_path):
    policy = TwinPolicy(
        VECTOR, spaces.Box(-2.0, 2.0, (1,), np.float32), lambda _: 0.0, net_arch=[4]
    )

    env = gym.make("Pendulum-v1")
    told = export_onnx(policy, tmp_path / "p.onnx", env=env).metadata

    assert told["dt"] == pytest.approx(0.05)
    assert [c["unit"] for c in told["observations"]["observation"]] == ["1", "1", "rad/s"]
    assert told["actions"] == [{"name": "torque", "unit": "N m", "low": -2.0, "high": 2.0}]


def test_a_file_that_would_act_otherwise_is_not_written(tmp_path, monkeypatch):
    policy, path = policy_of("gaussian"), tmp_path / "policy.onnx"
    path.write_bytes(b"older")
    predict = GaussianPolicy.predict
    monkeypatch.setattr(
        GaussianPolicy,
        "predict",
        lambda self, *a, **k: (predict(self, *a, **k)[0] + np.float32(1e-3), None),
    )

    with pytest.raises(ExportError, match=r"actions differ by 5\.0e-04.*Nothing was written"):
        export_onnx(policy, path)

    assert path.read_bytes() == b"older" and list(tmp_path.iterdir()) == [path]


# --- what remembers


def oscillators(control: str = "direct") -> OscillatorPolicy:
    at = (0, 2) if control == "track" else ()
    body = {
        "dt": 0.03,
        "control": control,
        "names": ("hip", "knee"),
        "position": at,
        "velocity": at,
        "seen_position": at,
        "seen_velocity": (1, 2) if at else (),
        "lower": (-2.0, 0.0),
        "upper": (2.0, 5.0),
        "rest": (0.0, 2.5),
    }
    policy = OscillatorPolicy(VECTOR, TORQUES, lambda _: 0.0, robot=body)
    policy.constants = policy.constants._replace(
        amplitude=np.array([1.5, 1.0]),
        offset=np.array([0.1, 2.0]),
        phase=np.array([0.0, 2.0]),
        omega_swing=np.asarray(9.0),
        omega_stance=np.asarray(4.0),
        kp=np.array([1.0, 0.7]),
        kd=np.array([0.1, 0.2]),
    )
    return policy


@pytest.fixture(scope="module")
def gait(tmp_path_factory):
    path = tmp_path_factory.mktemp("gait") / "gait.onnx"
    export_onnx(oscillators("track"), path)
    return path


def test_the_interval_of_oscillators_is_known_without_an_environment(gait):
    assert OnnxPolicy(gait).dt == 0.03


def test_phases_are_a_state_that_episodes_begin_anew(gait):
    policy, loaded = oscillators("track"), OnnxPolicy(gait)
    observations = drawn(VECTOR, 2 * 300, seed=0).reshape(300, 2, 3) / 3.0
    ours = theirs = None

    for k, rows in enumerate(observations):
        start = np.array([k == 0, k % 71 == 0])
        found, ours = loaded.predict(rows, ours, start)
        wanted, theirs = policy.predict(rows, theirs, start)
        np.testing.assert_allclose(found, wanted, atol=1e-6)

    assert [part["input"] for part in loaded.metadata["memory"]] == ["phase"]
    assert ours[0].shape == (2, 2) and ours[0].dtype == np.float64


@pytest.mark.parametrize("mode", ["offset", "parameters"])
def test_a_rhythm_under_a_policy_is_in_the_file(mode, tmp_path):
    def wrapped():
        return CPGPrior(gym.make("Pendulum-v1"), mode=mode, omega_swing=5.0, omega_stance=3.0)

    env, plain = wrapped(), gym.make("Pendulum-v1")
    policy = GaussianPolicy(env.observation_space, env.action_space, lambda _: 0.0, net_arch=[8])
    export_onnx(policy, tmp_path / "p.onnx", env=env)
    loaded, state = OnnxPolicy(tmp_path / "p.onnx"), None

    seen, _ = env.reset(seed=0)
    obs, _ = plain.reset(seed=0)
    for _ in range(100):
        action, state = loaded.predict(obs, state)
        chosen, _ = policy.predict(seen, deterministic=True)
        seen, _, _, _, info = env.step(chosen)
        np.testing.assert_allclose(action, info["safe_action"], atol=1e-4)
        obs, *_ = plain.step(action)
        np.testing.assert_allclose(obs, seen[:3], atol=1e-3)

    assert loaded.metadata["layers"] == ["Rhythm"] and loaded.dt == pytest.approx(0.05)


def test_layers_that_do_not_begin_with_constants_are_left_outside_on_request(tmp_path):
    env = ActionScale(gym.make("Pendulum-v1"), schedule=[[0, 0.5], [100, 1.0]])
    policy = GaussianPolicy(env.observation_space, env.action_space, lambda _: 0.0, net_arch=[4])

    with pytest.raises(ExportError, match="layers=False"):
        export_onnx(policy, tmp_path / "p.onnx", env=env)
    done = export_onnx(policy, tmp_path / "p.onnx", env=env, layers=False)

    assert done.metadata["outside"] == ["ActionScale"] and "ActionScale" in str(done)


# --- normalisation, and other libraries


@pytest.fixture
def statistics(tmp_path):
    env = VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]), clip_obs=1.5)
    env.obs_rms.mean, env.obs_rms.var = np.array([0.3, -0.2, 2.0]), np.array([0.2, 0.5, 9.0])
    env.save(str(tmp_path / "vecnormalize.pkl"))
    return env, tmp_path / "vecnormalize.pkl"


def test_statistics_of_vec_normalize_go_into_the_file(statistics, tmp_path):
    normalize, pickled = statistics
    policy = policy_of("gaussian")

    export_onnx(policy, tmp_path / "p.onnx", normalize=pickled)

    raw = drawn(VECTOR, 20, seed=5)
    wanted, _ = policy.predict(normalize.normalize_obs(raw), deterministic=True)
    np.testing.assert_allclose(OnnxPolicy(tmp_path / "p.onnx").predict(raw)[0], wanted, atol=1e-5)


def test_nothing_is_unpickled_unless_asked(exported, tmp_path, no_pickle):
    export_onnx(policy_of("twin"), tmp_path / "p.onnx")
    OnnxPolicy(tmp_path / "p.onnx")


def balance(model, rows) -> None:
    """Values of a fresh network of which each choice is the best somewhere."""
    layer = model.policy.q_net.q_net[-1]
    with th.no_grad():
        layer.bias -= model.policy.q_net(th.as_tensor(rows, dtype=th.float32)).mean(0)


@pytest.mark.parametrize(
    ("name", "env_id", "arguments"),
    [
        ("SAC", "Pendulum-v1", {"use_sde": True}),
        ("TD3", "Pendulum-v1", {}),
        ("PPO", "Pendulum-v1", {}),
        ("PPO", "CartPole-v1", {}),
        ("DQN", "CartPole-v1", {}),
    ],
)
def test_policies_of_stable_baselines3(name, env_id, arguments, tmp_path):
    model = getattr(sb3, name)("MlpPolicy", env_id, seed=0, **arguments)
    rows = np.random.default_rng(0).normal(size=(30, *model.observation_space.shape))
    if name == "DQN":
        balance(model, rows)

    done = export_onnx(model, tmp_path / "p.onnx")

    loaded = OnnxPolicy(done.path)
    wanted, _ = model.predict(rows.astype(np.float32), deterministic=True)
    np.testing.assert_allclose(loaded.predict(rows)[0], wanted, atol=2 * CLOSE)
    assert done.metadata["algorithm"] == name and len(np.unique(wanted)) > 1


@pytest.mark.parametrize("name", ["SAC", "CrossQ", "PPO"])
def test_policies_of_sbx(name, tmp_path):
    import sbx

    env_id = "CartPole-v1" if name == "PPO" else "Pendulum-v1"
    model = getattr(sbx, name)("MlpPolicy", env_id, seed=0, policy_kwargs={"net_arch": [16, 16]})

    loaded = OnnxPolicy(export_onnx(model, tmp_path / "p.onnx").path)

    rows = np.random.default_rng(0).normal(size=(30, *model.observation_space.shape))
    wanted, _ = model.predict(rows.astype(np.float32), deterministic=True)
    np.testing.assert_allclose(loaded.predict(rows)[0], wanted, atol=2 * CLOSE)


def test_what_cannot_be_exported_is_refused_with_a_reason(tmp_path):
    env = LowPassAction(gym.make("Pendulum-v1"), cutoff=2.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = sb3.SAC("MlpPolicy", env)
    with pytest.raises(ExportError, match="of torch"):
        export_onnx(model, tmp_path / "p.onnx")
    with pytest.raises(ExportError, match="can be exported, got str"):
        export_onnx("model.zip", tmp_path / "p.onnx")
    with pytest.raises(ExportError, match="all wrappers"):
        export_onnx(policy_of("gaussian"), tmp_path / "p.onnx", env=gym.make("CartPole-v1"))
    assert not (tmp_path / "p.onnx").exists()


@pytest.mark.parametrize(
    ("content", "why"),
    [(b"no onnx", "no ONNX file"), (None, "without 'sb3_hds.policy'")],
)
def test_other_files_are_refused(content, why, exported):
    if content is None:
        proto = onnx.load(exported("gaussian")[1])
        del proto.metadata_props[:]
        content = proto.SerializeToString()
    with pytest.raises(ExportError, match=why):
        OnnxPolicy(content)


def test_a_newer_file_is_refused(exported):
    proto = onnx.load(exported("gaussian")[1])
    told = json.loads(proto.metadata_props[0].value)
    proto.metadata_props[0].value = json.dumps(told | {"version": 2})
    with pytest.raises(ExportError, match="Upgrade"):
        OnnxPolicy(proto.SerializeToString())


@pytest.mark.parametrize(
    ("observation", "why"),
    [
        (np.zeros(4), "must have the shape"),
        (np.array([0.0, np.nan, 0.0]), "not finite"),
    ],
)
def test_odd_observations_are_refused(observation, why, exported):
    with pytest.raises(ValueError, match=why):
        OnnxPolicy(exported("gaussian")[1]).predict(observation)


def test_files_of_the_first_version_act_as_they_did():
    wanted = np.load(SAVED / "actions.npz")
    for path in sorted(SAVED.glob("*.onnx")):
        policy, state, found = OnnxPolicy(path), None, []
        for obs in wanted["observations"]:
            action, state = policy.predict(obs, state)
            found.append(action)
        np.testing.assert_allclose(found, wanted[path.stem], atol=1e-6)


# --- running


class Clock:
    """Of a machine on which a step takes no time."""

    def __init__(self):
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory):
    space = spaces.Box(-2.0, 2.0, (1,), np.float32)
    path = tmp_path_factory.mktemp("pendulum") / "pendulum.onnx"
    policy = TwinPolicy(VECTOR, space, lambda _: 0.0, net_arch=[4])
    export_onnx(policy, path, env=gym.make("Pendulum-v1"))
    return path


def test_a_run_keeps_its_rate_and_is_recorded(pendulum, tmp_path):
    clock = Clock()

    done = run_policy(
        OnnxPolicy(pendulum),
        gym.make("Pendulum-v1"),
        n_episodes=2,
        record=tmp_path / "run.jsonl",
        seed=0,
        clock=clock,
        sleep=clock.sleep,
    )

    assert done.timing.steps == len(done.inference) == 400 and done.timing.overruns == 0
    # The first command of an episode begins the ticks.
    assert clock.now == pytest.approx(2 * 199 * 0.05)
    assert len(done.returns) == 2 and "400 steps at 20 Hz" in str(done)
    data = Trajectories.load(tmp_path / "run.jsonl")
    assert data.obs.shape[:2] == (2, 201) and data.dt == pytest.approx(0.05)


def test_a_run_needs_a_rate_and_a_fitting_environment(exported, pendulum):
    with pytest.raises(ExportError, match="rate=50"):
        run_policy(OnnxPolicy(exported("gaussian")[1]), _Two())
    with pytest.raises(ExportError, match="takes 3 observed numbers"):
        run_policy(OnnxPolicy(pendulum), gym.make("MountainCarContinuous-v0"))
    with pytest.raises(ExportError, match="above 0"):
        run_policy(OnnxPolicy(pendulum), gym.make("Pendulum-v1"), rate=0.0)


class _Two(gym.Env):
    observation_space, action_space = VECTOR, TORQUES


def test_sb3_evaluates_a_file(pendulum):
    reward, _ = evaluate_policy(OnnxPolicy(pendulum), gym.make("Pendulum-v1"), 1, warn=False)
    assert -2_000.0 < reward < 0.0


def test_running_imports_neither_jax_nor_torch(pendulum, tmp_path):
    record = tmp_path / "run.jsonl"
    code = (
        "import sys\n"
        "from sb3_hds.cli import main\n"
        f"code = main(['run', {str(pendulum)!r}, '--env', 'Pendulum-v1', '--rate', '2000',"
        f" '--steps', '50', '--record', {str(record)!r}])\n"
        "heavy = {'jax', 'torch', 'stable_baselines3', 'flax', 'pandas'} & set(sys.modules)\n"
        "sys.exit(code or ' '.join(heavy) or 0)\n"
    )

    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)

    assert done.returncode == 0, done.stderr
    assert "50 steps at 2000 Hz" in done.stdout and "inference: median" in done.stdout
    assert len(record.read_text().splitlines()) == 1 + 1 + 50


# --- C

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no cc")


def compiled(header: Path) -> Path:
    program = header.with_suffix("")
    name = header.stem
    flags = ["-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror", f"-D{name.upper()}_MAIN"]
    subprocess.run(["cc", *flags, "-x", "c", str(header), "-lm", "-o", str(program)], check=True)
    return program


def answers(program: Path, rows: np.ndarray) -> np.ndarray:
    given = "\n".join(" ".join(map(repr, row)) for row in rows.astype(float).tolist())
    done = subprocess.run([str(program)], input=given, capture_output=True, text=True, check=True)
    return np.array([[float(x) for x in line.split()] for line in done.stdout.splitlines()])


@needs_compiler
@pytest.mark.parametrize("kind", KINDS)
def test_a_header_acts_as_its_policy(kind, exported, tmp_path):
    policy, path = exported(kind)

    done = export_c(path, tmp_path / "policy.h")

    observations = drawn(policy.observation_space, 20, seed=9)
    parts = observations.values() if isinstance(observations, dict) else [observations]
    rows = np.concatenate([np.reshape(part, (20, -1)) for part in parts], axis=1)
    wanted, _ = policy.predict(observations, deterministic=True)
    found = answers(compiled(tmp_path / "policy.h"), rows)
    np.testing.assert_allclose(found, wanted, atol=2.5 * CLOSE)
    assert done.largest_error <= CLOSE and 0.0 < done.median <= done.worst
    assert "malloc" not in (tmp_path / "policy.h").read_text()


@needs_compiler
def test_a_header_carries_the_phase(gait, tmp_path):
    export_c(gait, tmp_path / "gait.h")
    rows, policy, state, wanted = drawn(VECTOR, 200, seed=2) / 3.0, oscillators("track"), None, []
    for obs in rows:
        action, state = policy.predict(obs, state)
        wanted.append(action)

    np.testing.assert_allclose(answers(compiled(tmp_path / "gait.h"), rows), wanted, atol=1e-6)


@needs_compiler
@pytest.mark.parametrize("name", ["PPO", "DQN"])
def test_a_header_makes_choices(name, tmp_path):
    model = getattr(sb3, name)("MlpPolicy", "CartPole-v1", seed=0)
    rows = np.random.default_rng(0).normal(size=(50, 4)).astype(np.float32)
    if name == "DQN":
        balance(model, rows)
    export_onnx(model, tmp_path / "p.onnx")
    export_c(tmp_path / "p.onnx", tmp_path / "choices.h")

    wanted, _ = model.predict(rows, deterministic=True)

    assert answers(compiled(tmp_path / "choices.h"), rows).ravel().tolist() == wanted.tolist()
    assert len(set(wanted.tolist())) == 2


def test_operations_without_a_translation_are_named():
    from onnx import TensorProto, helper

    ends = [helper.make_tensor_value_info(n, TensorProto.FLOAT, [1, 3]) for n in ("x", "y")]
    node = helper.make_node("CumSum", ["x", "axis"], ["y"])
    axis = helper.make_tensor("axis", TensorProto.INT64, [], [1])
    graph = helper.make_graph([node], "g", ends[:1], ends[1:], [axis])
    with pytest.raises(ExportError, match="CumSum"):
        Translation(helper.make_model(graph), {"x": (1, 3)})


# --- the command line


@pytest.fixture(scope="module")
def saved_model(tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "model.zip"
    GSDESAC("Pendulum-v1", policy_kwargs={"net_arch": [8]}, buffer_size=10).save(path)
    return path


@needs_compiler
def test_the_command_exports_to_onnx_and_c(saved_model, tmp_path, capsys, no_pickle):
    onnx_file, header = tmp_path / "policy.onnx", tmp_path / "policy.h"

    code = main(
        ["export", str(saved_model), str(onnx_file), "--c", str(header), "--env", "Pendulum-v1"]
    )

    printed = capsys.readouterr().out
    assert code == 0 and onnx_file.exists() and header.exists()
    assert "1,000 observations: actions differ from predict by at most" in printed
    assert "bytes of constants" in printed and "worst of" in printed
    assert "torque [N m]" in header.read_text()


def test_the_command_says_what_is_wrong(saved_model, exported, tmp_path, capsys):
    model, wrong = str(saved_model), str(tmp_path / "nothing" / "p.onnx")
    for arguments, why in (
        ([model], "Name a file to write"),
        ([model, str(tmp_path / "p.txt")], "must end in .onnx"),
        ([model, wrong], "no such folder"),
        ([str(exported("twin")[1]), str(tmp_path / "p.onnx")], "exported already"),
        ([str(saved_model.with_name("mode.zip")), str(tmp_path / "p.onnx")], "Did you mean"),
    ):
        assert main(["export", *arguments]) == 1
        assert why in capsys.readouterr().err
    assert main(["run", str(saved_model), "--env", "Pendulum-v1", "--record", "-"]) == 1
    assert "no ONNX file" in capsys.readouterr().err


def test_every_public_name_is_there():
    assert all(hasattr(deploy, name) for name in deploy.__all__)


@pytest.mark.expensive
@pytest.mark.parametrize("name", NAMES)
def test_every_algorithm_is_exported_after_training(name, tmp_path):
    model = small(name)
    model.learn(30)

    done = model.export_onnx(tmp_path / "policy.onnx")
    header = export_c(done.path, tmp_path / "policy.h")

    assert done.largest_error <= CLOSE
    assert header.largest_error is None or header.largest_error <= CLOSE
