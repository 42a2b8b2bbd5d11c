"""Runs of every algorithm are tracked by Weights & Biases, offline, and by TensorBoard."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from small_models import PLANNERS

from sb3_hds import algos

pytest.importorskip("rl_zoo3")
pytest.importorskip("wandb", reason="needs the extra 'wandb'")

pytestmark = pytest.mark.expensive
ZOO = Path(sys.executable).with_name("rl_zoo3")
FEW = ("learning_starts:20", "batch_size:16", "policy_kwargs.net_arch:[8]")
PLANS = ("n_rollouts:8", "pretrain_epochs:1", "horizon:8", "gradient_steps:4", "n_random_plans:1")
PARAMS = dict.fromkeys(algos.ALL, FEW) | dict.fromkeys(PLANNERS, (*PLANS, "train_freq:50"))
PARAMS["openloop"] = ("population_size:3", "n_resets:1", "horizon:20", "n_elites:2")
EVALUATED = "eval/mean_reward"


def curves_in(folder: Path) -> dict[str, list[int]]:
    """By name, the steps of the points of a curve in the only file of TensorBoard."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    (file,) = folder.rglob("events.out.tfevents.*")
    events = EventAccumulator(str(file)).Reload()
    return {tag: [e.step for e in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


@pytest.mark.parametrize("algo", algos.ALL)
def test_the_zoo_tracks_a_run_of_every_algorithm(algo, tmp_path):
    command = (ZOO, "train", "--algo", algo, "--env", "Pendulum-v1", "--seed", "0", "-n", "200")
    options = ("--eval-freq", "100", "--eval-episodes", "1", "--log-interval", "1")
    tracked = ("--track", "--wandb-project-name", "ours", "-tags", "small")
    # Nothing is sent, and nothing is asked for.
    environ = os.environ | {"WANDB_MODE": "offline", "WANDB_SILENT": "true"}

    done = subprocess.run(
        (*command, *options, *tracked, "-params", *PARAMS[algo]),
        cwd=tmp_path,
        env=environ,
        timeout=300,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )

    assert done.returncode == 0, done.stdout[-4000:]
    curves = curves_in(tmp_path / "runs")
    assert curves[EVALUATED][-2:] == [100, 200]
    own = "search/" if algo == "openloop" else "train/"
    assert [name for name in curves if name.startswith(own)]
    (stored,) = tmp_path.glob("wandb/offline-run-*/run-*.wandb")
    content = stored.read_bytes()
    for text in ("ours", "small", algo, PARAMS[algo][0].partition(":")[0], EVALUATED):
        assert text.encode() in content
