"""A training process that dies in the middle of saving a checkpoint."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from small_models import steps_of

from sb3_hds import algos

# Several files of tensors go into each checkpoint: the process dies within the third one.
SCRIPT = """
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


ENVIRON = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}


@pytest.mark.parametrize(
    "name",
    ["droq", *(pytest.param(each, marks=pytest.mark.expensive) for each in ("hds", "openloop"))],
)
def test_the_last_checkpoint_of_a_killed_process_loads_and_trains_on(name, tmp_path):
    process = subprocess.run([sys.executable, "-c", SCRIPT, name, str(tmp_path)], env=ENVIRON)

    assert process.returncode == -signal.SIGKILL
    checkpoints = sorted(tmp_path.glob("*.zip"), key=lambda path: path.stat().st_mtime)
    assert [steps_of(path) for path in checkpoints] == [50, 100]
    model = algos.ALL[name].load(checkpoints[-1], env=gymnasium.make("Pendulum-v1"))
    updates = model._n_updates
    model.learn(50, reset_num_timesteps=False)
    assert model.num_timesteps == 150 and model._n_updates > updates
    weights = model.get_parameters()["policy"].values()
    assert all(np.isfinite(weight.numpy()).all() for weight in weights if weight.ndim)
