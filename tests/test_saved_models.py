"""
What was saved by this version is loaded by every later one, and acts as it did.

    python tests/test_saved_models.py      # writes tests/saved/NEWEST: once for each format
"""

import io
import json
import zipfile
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch as th
from small_models import EVERY_NAME, MODEL_FREE, SMALL, saved, small

import sb3_hds
from sb3_hds import algos

SAVED = Path(__file__).parent / "saved"
NEWEST = "0.1.0"
OBSERVATIONS = np.float32([[1.0, 0.0, 0.0], [-1.0, 0.0, 2.0], [0.6, -0.8, -7.5], [0.0, 1.0, 1.0]])
#: enough for updates, a real episode, and another network than at the start
N_STEPS = {"pods": 25, "hds": 50, "openloop": 24}
FILES = sorted(SAVED.glob("*/*.zip"))


def test_every_algorithm_has_a_file_of_its_first_version():
    assert {path.stem for path in FILES} == set(algos.ALL)


@pytest.mark.parametrize("name", EVERY_NAME)
def test_a_file_holds_what_the_newest_stored_one_holds(name):
    """Where this fails, files have another format: store some of it under a new name."""
    # Updates change numbers, and neither names nor shapes.
    without = {"learning_starts": 1_000} if name in MODEL_FREE else {}
    now = contents(saved(trained(name, **without)))
    assert now == contents(SAVED / NEWEST / f"{name}.zip")


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_a_policy_of_an_earlier_version_acts_alone(path, no_pickle):
    told = json.loads(path.with_suffix(".json").read_text())
    assert_acts(sb3_hds.load_policy(path), told["actions"])


@pytest.mark.parametrize("name", EVERY_NAME)
def test_a_model_of_the_first_version_acts_as_it_did_and_learns_on(name):
    path = SAVED / "0.1.0" / f"{name}.zip"
    told = json.loads(path.with_suffix(".json").read_text())

    model = algos.ALL[name].load(path, env=gymnasium.make("Pendulum-v1"))

    assert model.num_timesteps == told["num_timesteps"]
    assert_acts(model, told["actions"])
    model.learn(N_STEPS.get(name, 20), reset_num_timesteps=False)
    assert model.num_timesteps > told["num_timesteps"]


def assert_acts(model, expected):
    actions, _ = model.predict(OBSERVATIONS, deterministic=True)
    np.testing.assert_allclose(actions, expected, rtol=1e-4, atol=1e-5)


def trained(name, **changes):
    return small(name, **changes).learn(N_STEPS.get(name, 30))


def contents(file):
    """:return: by entry of the file, names of what is in it, and the shapes of tensors"""
    with zipfile.ZipFile(file) as opened:
        data = json.loads(opened.read("data"))
        found = {"data": set(data), "policy": set(data["policy_description"]["arguments"])}
        for entry in opened.namelist():
            if entry.endswith(".pth"):
                tensors = th.load(io.BytesIO(opened.read(entry)), weights_only=True)
                found[entry] = {path: value.shape for path, value in tensors.items()}
    return found


def write() -> None:
    folder = SAVED / NEWEST
    folder.mkdir(parents=True, exist_ok=True)
    for name in SMALL:
        model = trained(name)
        model.save(folder / f"{name}.zip")
        actions, _ = model.predict(OBSERVATIONS, deterministic=True)
        rounded = np.asarray(actions, float).round(7).tolist()
        told = {"actions": rounded, "num_timesteps": model.num_timesteps}
        (folder / f"{name}.json").write_text(json.dumps(told) + "\n")


if __name__ == "__main__":
    write()
