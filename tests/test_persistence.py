"""Saved models: whole, readable without JAX, and good to go on with."""

import io
import json
import os
import pickletools
import re
import signal
import subprocess
import sys
import warnings
import zipfile
from base64 import b64decode
from pathlib import Path

import flax
import gymnasium
import numpy as np
import optax
import pytest
import torch as th
from small_models import (
    EVERY_NAME,
    MODEL_FREE,
    OFF_POLICY,
    SMALL,
    STATES,
    greedy,
    reloaded,
    same,
    saved,
    small,
    steps_of,
)

from sb3_hds import algos, effects, twins
from sb3_hds.algos import persistence
from sb3_hds.errors import NoTwinError

pytestmark = pytest.mark.usefixtures("quick_compilation")
every_algorithm = pytest.mark.parametrize("name", EVERY_NAME)
PREDICT = """
import sys
import numpy as np
from sb3_hds import algos

folder, obs = sys.argv[1], np.load(sys.argv[1] + "/obs.npy")
for name in sys.argv[2:]:
    model = algos.ALL[name].load(f"{folder}/{name}")
    np.save(f"{folder}/{name}.npy", model.predict(obs, deterministic=True)[0])
"""


# The second device stands for an accelerator, which is where arrays go unless told otherwise.
TWO_DEVICES = """
import sys
import gymnasium
import flax
import jax
from sb3_hds import algos, load_policy

cpu, accelerator = jax.devices()
jax.config.update("jax_default_device", accelerator)

def check(policy):
    leaves = jax.tree.leaves((policy.weights, policy.training_state))
    where = {device for leaf in leaves if isinstance(leaf, jax.Array) for device in leaf.devices()}
    assert where == {cpu}, where

for name in ("droq", "td7", "hds"):
    path, env = f"{sys.argv[1]}/{name}.zip", gymnasium.make("Pendulum-v1")
    model = algos.ALL[name].load(path, env=env, device="cpu")
    check(model.policy)
    model.set_parameters(model.get_parameters())
    check(model.policy)
    check(model.learn(25).policy)
    check(load_policy(path))
"""


def pickled_names(data: dict) -> list[str]:
    """:return: every string in the pickles of SB3's ``data``: modules and classes among them"""
    pickles = [
        b64decode(entry[":serialized:"])
        for entry in data.values()
        if isinstance(entry, dict) and ":serialized:" in entry
    ]
    return [arg for each in pickles for _, arg, _ in pickletools.genops(each) if type(arg) is str]


@every_algorithm
def test_a_loaded_model_predicts_and_holds_the_same_and_goes_on(name, tmp_path):
    model = small(name).learn(50)
    n_updates, before = model._n_updates, model.get_parameters()

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = algos.ALL[name].load(saved(model))

    np.testing.assert_array_equal(greedy(loaded), greedy(model))
    assert same(before, loaded.get_parameters())
    of_buffer = ("train_freq",) if name in OFF_POLICY else ()
    for kept in ("num_timesteps", "_n_updates", "seed", "policy_kwargs", *of_buffer):
        assert getattr(loaded, kept) == getattr(model, kept), kept
    loaded.set_env(gymnasium.make("Pendulum-v1"))
    if name in OFF_POLICY:
        model.save_replay_buffer(tmp_path / "buffer")
        loaded.load_replay_buffer(tmp_path / "buffer")
        assert [path.name for path in tmp_path.iterdir()] == ["buffer.pkl"]
        ours, theirs = loaded.replay_buffer, model.replay_buffer
        np.testing.assert_array_equal(ours.observations, theirs.observations)
    loaded.learn(50, reset_num_timesteps=False)
    assert loaded.num_timesteps == 100 and loaded._n_updates > n_updates
    assert name not in OFF_POLICY or loaded.replay_buffer.size() == 100
    assert not same(before, loaded.get_parameters())


def test_another_process_predicts_the_same(tmp_path):
    np.save(tmp_path / "obs.npy", STATES)
    models = {name: small(name) for name in ("droq", "td7", "hds", "openloop")}
    for name, model in models.items():
        model.save(tmp_path / name)

    subprocess.run([sys.executable, "-c", PREDICT, str(tmp_path), *models], check=True)

    for name, model in models.items():
        # Two compilations may round differently.
        np.testing.assert_allclose(np.load(tmp_path / f"{name}.npy"), greedy(model), atol=1e-6)


@every_algorithm
def test_a_file_holds_tensors_and_no_objects_of_jax(name):
    of_jax = {"activation_fn": flax.linen.silu} if name in OFF_POLICY else {}
    of_jax |= {"optimizer_class": optax.adamw} if name in MODEL_FREE else {}
    chosen = {"policy_kwargs": SMALL[name]["policy_kwargs"] | of_jax} if of_jax else {}
    model = small(name, **chosen)
    archive = zipfile.ZipFile(saved(model))

    assert {"policy.pth", "policy.optimizer.pth", "data"} <= set(archive.namelist())
    for part in ("policy.pth", "policy.optimizer.pth"):
        tensors = th.load(io.BytesIO(archive.read(part)), weights_only=True)
        assert tensors and all(isinstance(value, th.Tensor) for value in tensors.values())
    names = pickled_names(json.loads(archive.read("data")))
    # The scan sees what it should see: the policy's class is stored by its name.
    assert any("Policy" in found for found in names)
    assert [found for found in names if re.search("jax|flax|optax|silu|adamw|learner", found)] == []
    again = {"policy_kwargs": model.policy_kwargs | of_jax} if of_jax else {}
    np.testing.assert_array_equal(greedy(reloaded(model, **again)), greedy(model))


@pytest.mark.expensive  # another process, which compiles for two devices
def test_what_is_loaded_stays_on_its_device(tmp_path):
    for name in ("droq", "td7", "hds"):
        model = small(name).learn(25)
        model.save(tmp_path / name)
        with pytest.warns(UserWarning, match="loaded on the CPU"):
            greedy(reloaded(model, device="cuda"))

    subprocess.run(
        [sys.executable, "-c", TWO_DEVICES, str(tmp_path)],
        check=True,
        env=os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=2"},
    )


def test_a_file_of_one_twin_algorithm_is_not_loaded_as_another():
    class Mine(algos.HDS):
        pass

    file = saved(small("hds"))

    with pytest.raises(ValueError, match=r"HDS saved this model: use HDS\.load, not PODS\.load"):
        algos.PODS.load(file)
    assert isinstance(Mine.load(file), Mine)


@pytest.mark.parametrize("name", ["droq", "td7", "hds"])
def test_arguments_may_be_changed_while_loading(name):
    loaded = reloaded(small(name), batch_size=8, learning_rate=1e-5)

    assert loaded.batch_size == 8 and loaded.lr_schedule(1.0) == 1e-5
    with pytest.raises(ValueError, match="policy kwargs"):
        reloaded(small(name), policy_kwargs={"net_arch": [4]})


@pytest.mark.parametrize("name", ["droq", "td7", "hds", "openloop"])
def test_parameters_make_a_round_trip_and_misfits_are_refused(name):
    one, other = small(name, seed=1), small(name, seed=2)

    other.set_parameters(one.get_parameters())

    before = one.get_parameters()
    assert same(before, other.get_parameters())
    with pytest.raises(ValueError, match="invalid object name"):
        one.set_parameters({**before, "nothing": {}})
    key, *others = before["policy"]
    given = before["policy"][key] + 1.0
    with pytest.raises(RuntimeError, match="missing"):
        one.set_parameters(before | {"policy": {key: given}})
    one.set_parameters({"policy": {key: given}}, exact_match=False)
    after = one.get_parameters()["policy"]
    assert th.equal(after[key], given)
    assert all(th.equal(after[other], before["policy"][other]) for other in others)
    other_size = {"policy_kwargs": {"net_arch": [9]}} if name in OFF_POLICY else {"n_elites": 9}
    with pytest.raises(RuntimeError, match="policy_kwargs"):
        small(name, **other_size).set_parameters(before)


def test_a_file_appears_when_it_is_complete_and_a_failed_save_leaves_the_older_one(
    tmp_path, monkeypatch
):
    model = small("droq")
    write, seen = th.save, []

    def watched(*args, **kwargs):
        seen.extend(path.suffix for path in tmp_path.iterdir())
        write(*args, **kwargs)

    monkeypatch.setattr(th, "save", watched)
    model.save(tmp_path / "model")
    assert set(seen) == {".tmp"}
    assert [path.name for path in tmp_path.iterdir()] == ["model.zip"]
    before = (tmp_path / "model.zip").read_bytes()

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(th, "save", full)
    with pytest.raises(OSError, match=r"model\.zip' could not be written: No space left"):
        model.save(tmp_path / "model")

    assert (tmp_path / "model.zip").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["model.zip"]


@pytest.mark.parametrize(
    ("kind", "given"),
    [(str, "model"), (Path, "model.best"), (str, "a/b/model")],
)
def test_a_file_gets_the_suffix_that_stable_baselines_would_give_it(given, kind, tmp_path):
    persistence.write_whole(kind(tmp_path / given), "zip", lambda file: file.write(b"content"))

    expected = tmp_path / (given if "." in given else f"{given}.zip")
    assert expected.read_bytes() == b"content"


def test_epochs_and_optimisers_go_on_after_loading():
    model = small("hds", pretrain_epochs=2).learn(50)
    epochs = int(model.policy.progress.n_epochs)
    loaded = reloaded(model)

    before = loaded.get_parameters()["policy.optimizer"]
    loaded.learn(25, reset_num_timesteps=False)

    after = loaded.get_parameters()["policy.optimizer"]
    # One epoch for 25 steps and no second pretraining, with four steps of Adam.
    assert int(after["n_epochs"]) == epochs + 1 == 5
    counts = [key for key in after if key.endswith("count")]
    assert counts and all(int(after[key]) == int(before[key]) + 4 for key in counts)
    assert loaded.twin_timesteps > model.twin_timesteps


def test_a_twin_that_was_passed_survives_saving():
    twin = twins.make("Pendulum", mass=1.2).extend(effects.ViscousFriction(b=0.1))
    model = small("hds", twin=twin)

    loaded = reloaded(model)

    assert loaded.twin == twin and loaded.twin.values == twin.values
    other = reloaded(model, twin=twins.make("Pendulum", mass=0.8))
    assert other.twin.values["mass"] == 0.8


def test_a_model_without_its_twin_predicts_with_a_warning_and_does_not_train():
    model = small("hds", twin=twins.make("Pendulum"))
    model.twin_spec["twin"] = "Vanished"

    with pytest.warns(UserWarning, match=r"'Vanished' is not registered here"):
        loaded = reloaded(model)

    greedy(loaded)
    with pytest.raises(NoTwinError, match=r"load\(path, env=env, twin=\.\.\.\)"):
        loaded.learn(25)


@pytest.mark.parametrize("name", ["droq", "td7", "hds", "openloop"])
def test_a_policy_can_be_saved_alone(name, tmp_path):
    # A function of one's own, which no description of the policy may need.
    rate = {"learning_rate": lambda left: 1e-3 * left} if name in OFF_POLICY else {}
    expected = small(name, **rate).policy

    expected.save(tmp_path / "policy.pth")
    policy = type(expected).load(tmp_path / "policy.pth")

    np.testing.assert_array_equal(greedy(policy), greedy(expected))
    assert same({"": policy.state_dict()}, {"": expected.state_dict()})


@pytest.mark.parametrize("name", ["droq", "hds", "openloop"])
def test_saving_does_not_change_what_training_does(name):
    quiet, saving = small(name).learn(50), small(name)

    saving.learn(50, callback=lambda *_: saving.num_timesteps % 10 or saved(saving) is not None)

    assert same(quiet.get_parameters(), saving.get_parameters())


# Several files of tensors go into each checkpoint: the process dies within the third one.
DIES = """
import glob, os, signal, sys
import torch
from small_models import small
from stable_baselines3.common.callbacks import CheckpointCallback

write, calls = torch.save, []

def deadly(*args, **kwargs):
    calls.append(len(glob.glob(sys.argv[2] + "/*.zip")))
    if calls.count(2) == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    write(*args, **kwargs)

torch.save = deadly
small(sys.argv[1]).learn(1_000, callback=CheckpointCallback(50, sys.argv[2]))
"""


def test_the_last_checkpoint_of_a_killed_process_loads_and_trains_on(tmp_path):
    environ = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.run([sys.executable, "-c", DIES, "droq", str(tmp_path)], env=environ)

    assert process.returncode == -signal.SIGKILL
    checkpoints = sorted(tmp_path.glob("*.zip"), key=lambda path: path.stat().st_mtime)
    assert [steps_of(path) for path in checkpoints] == [50, 100]
    model = algos.DroQ.load(checkpoints[-1], env="Pendulum-v1")
    updates = model._n_updates
    model.learn(50, reset_num_timesteps=False)
    assert model.num_timesteps == 150 and model._n_updates > updates
    weights = model.get_parameters()["policy"].values()
    assert all(np.isfinite(weight.numpy()).all() for weight in weights if weight.ndim)
