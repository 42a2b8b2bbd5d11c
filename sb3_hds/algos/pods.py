"""Policy optimisation through differentiable simulation."""

from typing import Any

from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import LinearSchedule

from sb3_hds.algos.twin_algorithm import TwinAlgorithm
from sb3_hds.core import Twin


class PODS(TwinAlgorithm):
    """
    x
    """

    def __init__(
        self,
        policy: str | type[BasePolicy] | GymEnv = "MlpPolicy",
        env: GymEnv | str | None = None,
        *,
        learning_rate: float | Schedule = LinearSchedule(3e-3, 1e-4, 1.0),  # noqa: B008
        value_learning_rate: float | str | Schedule | None = None,
        buffer_size: int = 100_000,
        learning_starts: int = 0,
        batch_size: int = 512,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 100,
        gradient_steps: int = 96,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        twin: Twin | str | None = None,
        pretrain_epochs: int = 200,
        n_rollouts: int = 128,
        horizon: int | None = None,
        order: int = 2,
        planner: str | None = None,
        n_iterations: int = 3,
        n_step_sizes: int = 6,
        n_random_plans: int = 15,
        lookahead: int | None = None,
        terminal_value: bool = True,
        reset_share: float = 0.3,
        exploration_noise: float = 0.0,
        exploration_decay: float = 1.0,
        temperature: float = 0.0,
        temperature_decay: float = 0.97,
        relabel_share: float = 0.0,
        plan_memory: int = 8,
        loss: str = "smooth_absolute",
        gain_weight: float = 0.9,
        sensitivity_weight: float = 0.9,
        averaging: float = 0.9,
        policy_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        device: str = "auto",
        seed: int | None = None,
        monitor_wrapper: bool = True,
        _init_setup_model: bool = True,
    ) -> None:
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            value_learning_rate=value_learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            gamma=gamma,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            twin=twin,
            pretrain_epochs=pretrain_epochs,
            n_rollouts=n_rollouts,
            horizon=horizon,
            order=order,
            planner=planner,
            n_iterations=n_iterations,
            n_step_sizes=n_step_sizes,
            n_random_plans=n_random_plans,
            lookahead=lookahead,
            terminal_value=terminal_value,
            reset_share=reset_share,
            exploration_noise=exploration_noise,
            exploration_decay=exploration_decay,
            temperature=temperature,
            temperature_decay=temperature_decay,
            relabel_share=relabel_share,
            plan_memory=plan_memory,
            loss=loss,
            gain_weight=gain_weight,
            sensitivity_weight=sensitivity_weight,
            averaging=averaging,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            monitor_wrapper=monitor_wrapper,
            _init_setup_model=_init_setup_model,
        )
