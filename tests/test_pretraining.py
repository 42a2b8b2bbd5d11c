"""What callbacks and loggers make of planning epochs before the first real step."""

import os
import signal
import threading
import time

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.classic_control import PendulumEnv
from small_models import compilations, logged, reloaded, small
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    ProgressBarCallback,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.monitor import Monitor

from sb3_hds import algos
from sb3_hds.algos.twin import algorithm as twin_algorithm


class Noting(BaseCallback):
    """Notes what it is called with, and says no at one call."""

    def __init__(self, stop_at: int | None = None) -> None:
        super().__init__()
        self.stop_at, self.seen, self.on_noted = stop_at, {}, lambda _: None

    def _on_step(self) -> bool:
        self.on_noted(self.locals)
        ends = bool(self.locals["dones"].any())
        self.seen[self.locals["pretraining"], self.num_timesteps, self.n_calls, ends] = None
        return self.n_calls != self.stop_at


def test_what_is_logged_and_evaluated_has_a_series_of_its_own_whose_axis_moves(tmp_path):
    model = small("hds", pretrain_epochs=21)
    lines = logged(model)
    env = Monitor(gymnasium.make("Pendulum-v1", max_episode_steps=20))
    how = {"eval_freq": 10, "n_eval_episodes": 1, "verbose": 0}
    evaluation = EvalCallback(env, log_path=str(tmp_path), **how)

    model.learn(50, callback=evaluation, log_interval=1)

    # Ten lines before the first of the two epochs that come after 25 steps each.
    epochs = "pretrain/time/epochs"
    assert lines.steps(epochs) == lines.column(epochs) == lines.steps("pretrain/plan_return_after")
    assert 10 <= len(lines.steps(epochs)) <= 11 and lines.steps(epochs)[-1] in (20, 21)
    keys = {key for line in lines.lines for key in line} - {"step"}
    assert all(min(lines.steps(key)) > 0 for key in keys)
    assert not [key for key in keys if "pretrain/train" in key]
    assert lines.steps("pretrain/eval/mean_reward") == [10, 20]
    # Pretraining has an odd number of epochs: calls are counted from the first step on.
    assert lines.steps("eval/mean_reward") == [10, 20, 30, 40, 50]
    assert np.load(tmp_path / "evaluations.npz")["timesteps"][:3].tolist() == [0, 0, 10]


def test_callbacks_are_called_after_each_epoch_and_no_timestep_is_counted():
    noting, progress, names = Noting(), ProgressBarCallback(), {}
    episodes = StopTrainingOnMaxEpisodes(max_episodes=1)
    noting.on_noted = lambda local: names.setdefault(local["pretraining"], set(local))

    model = small("hds", pretrain_epochs=3)
    model.learn(25, callback=[CallbackList([noting, progress]), episodes])

    before = [(True, 0, n, False) for n in range(1, 4)]
    assert list(noting.seen) == before + [(False, n, n, False) for n in range(1, 26)]
    assert (noting.n_calls, progress.pbar.n, model.num_timesteps) == (25, 25, 25)
    assert names[False] - names[True] <= {"__class__"}


def test_a_callback_that_says_no_ends_pretraining_and_a_checkpoint_goes_on(monkeypatch, tmp_path):
    model = small("hds", pretrain_epochs=5)
    monkeypatch.setattr(PendulumEnv, "step", None)

    model.learn(50, callback=[CheckpointCallback(2, str(tmp_path)), Noting(), Noting(stop_at=2)])

    assert (model.n_pretrained, model.num_timesteps) == (2, 0)
    checkpoint = tmp_path / "rl_model_0_steps.zip"
    loaded = algos.HDS.load(checkpoint, env=gymnasium.make("Pendulum-v1"))
    assert loaded.n_pretrained == 2
    assert model.learn(0).n_pretrained == loaded.learn(0).n_pretrained == 5


def slow_programs(monkeypatch) -> None:
    wait = lambda *_: [lambda: time.sleep(4.0)]  # noqa: E731
    monkeypatch.setattr(twin_algorithm, "programs", wait)


def test_a_limit_of_time_acts_while_programs_compile(monkeypatch):
    slow_programs(monkeypatch)
    model, begin = small("hds"), time.monotonic()
    model.learn(50, callback=lambda *_: time.monotonic() < begin + 1.0)
    assert time.monotonic() - begin < 2.5 and (model.n_pretrained, model.num_timesteps) == (0, 0)


def test_an_interrupt_acts_while_programs_compile(monkeypatch):
    slow_programs(monkeypatch)
    model, begin = small("hds"), time.monotonic()
    threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT)).start()

    with pytest.raises(KeyboardInterrupt):
        model.learn(50)

    assert time.monotonic() - begin < 2.5 and model.logger is not None and model.n_pretrained == 0


def test_no_program_is_compiled_twice():
    programs = ("fresh_networks", "init_workspace", "plan_ahead", "learn_policy", "learn_value")
    with compilations() as counts:
        # Sizes that no other test has: nothing of it is compiled yet.
        own = {"horizon": 5, "policy_kwargs": {"net_arch": [5]}}
        # Policies are compared after the tenth epoch.
        model = small("hds", pretrain_epochs=10, **own).learn(25)
        # What is loaded has the types that it had when it was saved.
        reloaded(model).learn(50, reset_num_timesteps=False)

    assert {name: counts[name] for name in (*programs, "mean_return")} == dict.fromkeys(
        (*programs, "mean_return"), 1
    )
