"""Policy optimisation through differentiable simulation."""

from typing import Any

from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import LinearSchedule

from sb3_hds.algos.twin.algorithm import TwinAlgorithm
from sb3_hds.core import Twin


class PODS(TwinAlgorithm):
    """
    Policy optimisation through differentiable simulation.

    In each epoch, roll the policy out in the twin from many start states, improve each *sequence of
    actions* by its first- or second-order model with a line search in the simulator, and regress
    the policy on the states of the improved trajectories. No plan is ever worse than what it
    started from.

    Where this differs from the paper by default, because whole episodes planned from scratch get
    stuck on swing-ups: short horizons with a learned terminal value, random warm starts, start
    states that go on from epoch to epoch, weighted regression. Every one of these is an argument,
    so that the paper's setting can be reached::

        PODS(env, planner="gauss_newton", horizon=100, n_iterations=1, n_random_plans=0,
             lookahead=0, terminal_value=False, reset_share=1.0, plan_memory=1, loss="squared",
             gain_weight=0.0, sensitivity_weight=0.0, averaging=0.0, adapt_scales=False,
             learned_share=1.0, compare_every=0, least_gain=0.0, gamma=1.0, gradient_steps=50,
             policy_kwargs={"linear_path": False})

    Paper: Mora, Peychev, Ha, Vechev, Coros, *PODS: Policy Optimization via Differentiable
    Simulation*, ICML 2021, PMLR 139:7805-7817.

    :param policy: ``"MlpPolicy"``, a policy class, or the environment itself
    :param env: an environment with a twin, its id, or a vectorised environment
    :param learning_rate: of the policy, per Adam step; a schedule runs over all planning epochs,
        pretraining included. Own choice, measured.
    :param value_learning_rate: of the value network; number, schedule or ``"lin_3e-3"``. None: as
        ``learning_rate``.
    :param buffer_size: real transitions that are kept
    :param learning_starts: real steps with random actions before the policy acts
    :param batch_size: states per regression step
    :param gamma: discount per step of the environment
    :param train_freq: real steps between two planning epochs, or ``(n, "episode")``
    :param gradient_steps: regression steps per planning epoch; -1: as many as real steps were made
        (the paper: 50)
    :param action_noise: added to the actions in the real environment
    :param replay_buffer_class: as in SB3
    :param replay_buffer_kwargs: as in SB3
    :param optimize_memory_usage: as in SB3
    :param twin: the simulation to plan in, or its name; None: the one that mirrors the environment.
        Pass a different one to learn in a model that is wrong on purpose.
    :param pretrain_epochs: planning epochs before the first real step
    :param n_rollouts: start states planned from in each epoch (the paper: 4000)
    :param horizon: steps of a plan; None: 0.6 s, between 12 and 32 steps (the paper: the whole
        episode of 100)
    :param order: 1: gradient of the action sequence; 2: its Gauss-Newton step with feedback (iLQR)
    :param planner: overrides ``order``: ``"first_order"``, ``"gauss_newton"`` (the paper's
        open-loop second-order step) or ``"ilqr"``
    :param n_iterations: improvements of each plan in an epoch (the paper: 1)
    :param n_step_sizes: candidates of each line search, "no change" included
    :param n_random_plans: random sequences of which the best is improved too, the remedy against
        local optima; 0 switches it off (the paper)
    :param random_share: share of start states for which they are tried
    :param lookahead: steps for which the policy is followed beyond the end of a plan when plans are
        compared; None: five horizons; 0 switches it off (the paper)
    :param terminal_value: whether a value network judges the end of a plan (the paper: no)
    :param shift_ends: whether an episode that has terminated counts as one that earns the reward
        zero for ever. Rewards are counted from the best one that was seen; without it, an end is
        worth zero on that scale, and dying pays.
    :param reset_share: share of start states drawn from the reset distribution in each epoch, the
        others go on from where the policy went; 1 is the paper's choice
    :param exploration_noise: standard deviation of a constant offset of the controls while start
        states go on, in units of the typical size of the plans' controls
    :param plan_memory: epochs whose plans are learned from (the paper: 1)
    :param learned_share: share of each plan, from its start, that is learned from: what it does at
        its end depends most on the learned value (the paper: 1)
    :param loss: ``"smooth_absolute"`` (in units of the typical control, see the documentation) or
        ``"squared"`` (the paper)
    :param gain_weight: 0..1, how much a sample counts in proportion to what its plan gained over
        the policy (the paper: 0)
    :param sensitivity_weight: 0..1, how much it counts in proportion to what an error of its
        control costs; only with ``"ilqr"`` (the paper: 0)
    :param averaging: decay per epoch of the average of policies (the paper: 0)
    :param adapt_scales: whether the scales of the networks' inputs and of the regression's errors
        follow the plans (near a balance both are far smaller than in random rollouts); False keeps
        those of the first rollouts
    :param compare_every: epochs after which the average policy and the one that acts go through
        whole episodes of the twin, and the better one acts from then on; 0: the average acts (the
        paper)
    :param least_gain: the pretraining ends when plans have gained less than this share of the
        policy's return, on the average of about ten epochs; 0: never
    :param randomisation: domain randomisation: standard deviation of the twin's parameters between
        rollouts, in units of each parameter's ``scale``; 0: none
    :param policy_kwargs: ``net_arch``, ``activation_fn``, ``linear_path``, ``max_grad_norm``
    :param stats_window_size: episodes in the averages that are logged
    :param tensorboard_log: folder for TensorBoard
    :param verbose: 0 nothing, 1 information, 2 debugging
    :param device: ``"auto"``, ``"cpu"`` or ``"cuda"``, as JAX has it
    :param seed: of all random numbers
    :param monitor_wrapper: as in SB3
    :param _init_setup_model: as in SB3
    """

    def __init__(
        self,
        policy: str | type[BasePolicy] | GymEnv = "MlpPolicy",
        env: GymEnv | str | None = None,
        learning_rate: float | Schedule = LinearSchedule(5e-3, 1e-4, 1.0),  # noqa: B008
        *,
        value_learning_rate: float | str | Schedule | None = None,
        buffer_size: int = 100_000,
        learning_starts: int = 0,
        batch_size: int = 256,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 100,
        gradient_steps: int = 96,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        twin: Twin | str | None = None,
        pretrain_epochs: int = 160,
        n_rollouts: int = 128,
        horizon: int | None = None,
        order: int = 2,
        planner: str | None = None,
        n_iterations: int = 3,
        n_step_sizes: int = 6,
        n_random_plans: int = 7,
        random_share: float = 0.5,
        lookahead: int | None = None,
        terminal_value: bool = True,
        shift_ends: bool = True,
        reset_share: float = 0.5,
        exploration_noise: float = 0.0,
        plan_memory: int = 8,
        learned_share: float = 0.5,
        loss: str = "smooth_absolute",
        gain_weight: float = 0.7,
        sensitivity_weight: float = 0.7,
        averaging: float = 0.9,
        adapt_scales: bool = True,
        compare_every: int = 10,
        least_gain: float = 1e-3,
        randomisation: float = 0.0,
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
            random_share=random_share,
            lookahead=lookahead,
            terminal_value=terminal_value,
            shift_ends=shift_ends,
            reset_share=reset_share,
            exploration_noise=exploration_noise,
            exploration_decay=1.0,
            temperature=0.0,
            temperature_decay=1.0,
            relabel_share=0.0,
            plan_memory=plan_memory,
            learned_share=learned_share,
            loss=loss,
            gain_weight=gain_weight,
            sensitivity_weight=sensitivity_weight,
            averaging=averaging,
            adapt_scales=adapt_scales,
            compare_every=compare_every,
            least_gain=least_gain,
            randomisation=randomisation,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            monitor_wrapper=monitor_wrapper,
            _init_setup_model=_init_setup_model,
        )
