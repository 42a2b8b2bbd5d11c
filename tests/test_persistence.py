"""Saved models: whole, readable without JAX, and good to go on with."""

import io
import json
import os
import pickletools
import re
import subprocess
import sys
import warnings
import zipfile
from base64 import b64decode
from unittest.mock import Mock

import flax
import numpy as np
import optax
import pytest
import torch as th
from small_models import (
    EVERY_NAME,
    MODEL_FREE,
    OFF_POLICY,
    SMALL,
    greedy,
    reloaded,
    same,
    saved,
    small,
)

from sb3_hds import algos, effects, twins
from sb3_hds.algos.base import files
from sb3_hds.errors import NoTwinError

every_algorithm = pytest.mark.parametrize("name", EVERY_NAME)
#: one of each way of learning
every_kind = pytest.mark.parametrize("name", ["droq", "hds", "openloop"])


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

for name in ("td7", "hds"):
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
def test_a_file_holds_tensors_and_nothing_of_jax_and_its_model_goes_on(name, tmp_path):
    of_jax = {"activation_fn": flax.linen.silu} if name in OFF_POLICY else {}
    of_jax |= {"optimizer_class": optax.adamw} if name in MODEL_FREE else {}
    chosen = {"policy_kwargs": SMALL[name]["policy_kwargs"] | of_jax} if of_jax else {}
    model = small(name, **chosen).learn(50)
    n_updates, before, file = model._n_updates, model.get_parameters(), saved(model)

    archive = zipfile.ZipFile(file)
    for part in ("policy.pth", "policy.optimizer.pth"):
        tensors = th.load(io.BytesIO(archive.read(part)), weights_only=True)
        assert tensors and all(isinstance(value, th.Tensor) for value in tensors.values())
    names = pickled_names(json.loads(archive.read("data")))
    # The scan sees what it should see: spaces are pickled.
    assert any("gymnasium.spaces" in found for found in names)
    forbidden = r"jax|flax|optax|silu|adamw|learner|sb3_hds\.(?!algos$)"
    assert [found for found in names if re.search(forbidden, found)] == []

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = algos.ALL[name].load(file)
    np.testing.assert_array_equal(greedy(loaded), greedy(model))
    assert same(before, loaded.get_parameters())
    of_buffer = ("train_freq",) if name in OFF_POLICY else ()
    for kept in ("num_timesteps", "_n_updates", "seed", *of_buffer):
        assert getattr(loaded, kept) == getattr(model, kept), kept
    again = {"policy_kwargs": model.policy_kwargs | of_jax} if of_jax else {}
    loaded = reloaded(model, **again)
    np.testing.assert_array_equal(greedy(loaded), greedy(model))

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


@pytest.mark.expensive  # another process, which compiles for two devices
def test_what_is_loaded_stays_on_its_device(tmp_path):
    for name in ("td7", "hds"):
        model = small(name).learn(25)
        model.save(tmp_path / name)
        with pytest.warns(UserWarning, match="loaded on the CPU"):
            greedy(reloaded(model, device="cuda"))

    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=2"
    command = [sys.executable, "-c", TWO_DEVICES, str(tmp_path)]
    subprocess.run(command, check=True, env=os.environ | {"XLA_FLAGS": flags})


def test_a_file_of_one_twin_algorithm_is_not_loaded_as_another():
    class Mine(algos.HDS):
        pass

    file = saved(small("hds"))

    with pytest.raises(ValueError, match=r"HDS saved this model: use HDS\.load, not PODS\.load"):
        algos.PODS.load(file)
    assert isinstance(Mine.load(file), Mine)


@every_kind
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


def test_a_file_appears_complete_and_a_failed_save_leaves_the_older_one(tmp_path, monkeypatch):
    model = small("droq")
    write, seen = th.save, []

    def watched(*args, **kwargs):
        seen.extend(path.suffix for path in tmp_path.iterdir())
        write(*args, **kwargs)

    monkeypatch.setattr(th, "save", watched)
    model.save(tmp_path / "model")
    assert set(seen) == {".tmp"}
    before = (tmp_path / "model.zip").read_bytes()

    monkeypatch.setattr(th, "save", Mock(side_effect=OSError(28, "No space left on device")))
    with pytest.raises(OSError, match=r"model\.zip' could not be written: No space left"):
        model.save(tmp_path / "model")

    assert (tmp_path / "model.zip").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["model.zip"]


def test_a_file_gets_the_suffix_that_stable_baselines_would_give_it(tmp_path):
    for given, expected in (("model.best", "model.best"), ("a/b/model", "a/b/model.zip")):
        files.write_whole(str(tmp_path / given), "zip", lambda file: file.write(b"content"))
        assert (tmp_path / expected).read_bytes() == b"content"


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


def test_a_twin_that_was_passed_survives_saving_and_without_it_a_model_acts_but_does_not_train():
    twin = twins.make("Pendulum", mass=1.2).extend(effects.ViscousFriction(b=0.1))
    model = small("hds", twin=twin)

    loaded = reloaded(model)

    assert loaded.twin == twin and loaded.twin.values == twin.values
    other = reloaded(model, twin=twins.make("Pendulum", mass=0.8))
    assert other.twin.values["mass"] == 0.8
    model.twin_spec["twin"] = "Vanished"
    with pytest.warns(UserWarning, match=r"'Vanished' is not registered here"):
        loaded = reloaded(model)
    np.testing.assert_array_equal(greedy(loaded), greedy(model))
    with pytest.raises(NoTwinError, match=r"load\(path, env=env, twin=\.\.\.\)"):
        loaded.learn(25)


@every_kind
def test_a_policy_can_be_saved_alone(name, tmp_path):
    # A function of one's own, which no description of the policy may need.
    rate = {"learning_rate": lambda left: 1e-3 * left} if name in OFF_POLICY else {}
    expected = small(name, **rate).policy

    expected.save(tmp_path / "policy.pth")
    policy = type(expected).load(tmp_path / "policy.pth")

    assert same({"": policy.state_dict()}, {"": expected.state_dict()})


@every_kind
def test_saving_does_not_change_what_training_does(name):
    quiet, saving = small(name).learn(50), small(name)
    saving.learn(50, callback=lambda *_: saving.num_timesteps % 10 or saved(saving) is not None)
    assert same(quiet.get_parameters(), saving.get_parameters())
