"""Arguments of the algorithms that plan in a twin, and the epoch's static configuration."""

import dataclasses
import math
from dataclasses import KW_ONLY, field

import numpy as np
from stable_baselines3.common.utils import LinearSchedule

from sb3_hds.algos.base.config import OffPolicyConfig, Rate, between
from sb3_hds.algos.twin.policy import TwinPolicy
from sb3_hds.algos.twin.state import EpochConfig
from sb3_hds.core import Twin
from sb3_hds.planning import METHODS

# Default horizon [s], and its limits [steps].
_HORIZON = 0.6
_SHORTEST, _LONGEST = 12, 32
# Default lookahead, in horizons.
_LOOKAHEAD = 5


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Refinements:
    """
    How plans are improved and learned from. These are arguments of PODS, so that the paper's
    settings can be reproduced; HDS uses the defaults, which ``benchmarks/payload.py`` compares with
    the paper's.

    :param n_iterations: improvements of each plan per epoch (the paper: 1)
    :param n_step_sizes: candidates of each line search, "no change" included
    :param plan_memory: number of latest epochs whose plans are learned from (the paper: 1)
    :param learned_share: share of each plan, from its start, that the policy learns from: the end
        of a plan depends most on the learned value (the paper: 1)
    :param loss: ``"smooth_absolute"``, in units of the typical control, or ``"squared"`` (the
        paper); see :func:`~sb3_hds.algos.twin.regression.learn_policy`
    :param gain_weight: 0..1, share of a sample's weight that is proportional to the gain of its
        plan over the policy (the paper: 0)
    :param sensitivity_weight: 0..1, share of a sample's weight that is proportional to the cost of
        an error in its control; only with ``"ilqr"`` (the paper: 0)
    :param averaging: decay per epoch of the moving average of policies (the paper: 0)
    :param adapt_scales: whether the scales of the networks' inputs and of the regression's errors
        follow the plans (near a balance, both are far smaller than in random rollouts); False keeps
        those of the first rollouts
    :param compare_every: epochs between two comparisons of the averaged policy with the acting one
        on full episodes of the twin, after which the better one acts; 0: the averaged policy acts
        (the paper)
    :param least_gain: the pretraining ends when the gain of plans, averaged over about ten epochs,
        is less than this share of the policy's return; 0: never
    """

    n_iterations: int = 3
    n_step_sizes: int = 6
    plan_memory: int = 8
    learned_share: float = 0.5
    loss: str = "smooth_absolute"
    gain_weight: float = 0.7
    sensitivity_weight: float = 0.7
    averaging: float = 0.9
    adapt_scales: bool = True
    compare_every: int = 10
    least_gain: float = 1e-3


@dataclasses.dataclass(frozen=True, eq=False)
class TwinConfig(OffPolicyConfig):
    """
    Arguments of PODS and HDS.

    :param env: an environment with a twin, its id, or a vectorised environment
    :param learning_rate: of policy and value, per Adam step; a schedule runs over all planning
        epochs, pretraining included. Own choice, measured.
    :param buffer_size: capacity of the replay buffer [real transitions]
    :param learning_starts: real steps with random actions before the policy acts
    :param batch_size: states per regression step
    :param train_freq: real steps between two planning epochs, or ``(n, "episode")``
    :param gradient_steps: regression steps per planning epoch; -1: as many as real steps since the
        last epoch (the paper: 50)
    :param action_noise: added to the actions in the real environment
    :param twin: the simulation to plan in, or its name; None: the environment's twin. Pass another
        one to learn in a model that is wrong on purpose.
    :param pretrain_epochs: planning epochs before the first real step
    :param n_rollouts: start states per epoch, each with a plan (the paper: 4000)
    :param horizon: steps of a plan; None: 0.6 s, between 12 and 32 steps (the paper: the full
        episode of 100)
    :param planner: ``"ilqr"``: second-order steps with feedback and limits on the controls;
        ``"gauss_newton"``: the paper's open-loop second-order step; ``"first_order"``: gradient of
        the action sequence
    :param n_random_plans: random sequences per start state, for half of the start states; the best
        of them is improved, too, against local optima; 0: none (the paper)
    :param lookahead: steps of the policy beyond the end of a plan, simulated to compare plans;
        None: five horizons; 0: none (the paper)
    :param terminal_value: whether a learned value is added at the end of a plan (the paper: no)
    :param shift_ends: whether a terminated episode counts as one that earns zero reward for ever.
        Planning subtracts the best observed reward from all rewards; without the shift, termination
        has the value zero on that scale, and terminating early pays.
    :param reset_share: share of start states drawn from the reset distribution in each epoch; the
        policy advances the others (the paper: 1)
    :param exploration_noise: standard deviation of a constant offset of the controls while start
        states are advanced, in units of the typical size of the plans' controls
    :param randomisation: domain randomisation: standard deviation of the twin's parameters between
        rollouts, in units of each parameter's ``scale``; 0: none
    :param policy_kwargs: ``net_arch``, ``activation_fn``, ``linear_path``, ``max_grad_norm``; see
        :class:`~sb3_hds.algos.TwinPolicy`
    """

    learning_rate: Rate = LinearSchedule(5e-3, 1e-4, 1.0)  # noqa: RUF009  never changed
    _: KW_ONLY
    buffer_size: int = 100_000
    learning_starts: int = 0
    train_freq: int | tuple[int, str] | None = 100
    gradient_steps: int = 96
    twin: Twin | str | None = None
    pretrain_epochs: int = 160
    n_rollouts: int = 128
    horizon: int | None = None
    planner: str = "ilqr"
    n_random_plans: int = 7
    lookahead: int | None = None
    terminal_value: bool = True
    shift_ends: bool = True
    reset_share: float = 0.5
    exploration_noise: float = 0.0
    randomisation: float = 0.0
    exploration_decay: float = field(default=1.0, init=False)
    temperature: float = field(default=0.0, init=False)
    derived = ("horizon", "lookahead")

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_counts(
            {
                "n_rollouts": 1,
                "horizon": 1,
                "lookahead": 0,
                "n_random_plans": 0,
                "pretrain_epochs": 0,
            }
        )
        self.require_range(0.0, 1.0, "a number from 0 to 1", "reset_share", "exploration_decay")
        non_negative = ("temperature", "exploration_noise", "randomisation")
        self.require_range(0.0, math.inf, "a finite number of at least 0", *non_negative)
        fine = between(self.gamma, 0.0, 1.0) and self.gamma > 0.0
        self.require(fine, "gamma", "a number above 0 and at most 1")
        self.require_choice("planner", list(METHODS))

    @property
    def refinements(self) -> Refinements:
        """How plans are improved and learned from."""
        return Refinements()


@dataclasses.dataclass(frozen=True, eq=False)
class PODSConfig(Refinements, TwinConfig):
    """Arguments of PODS."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_counts(
            {"n_iterations": 1, "n_step_sizes": 2, "plan_memory": 1, "compare_every": 0}
        )
        shares = ("learned_share", "gain_weight", "sensitivity_weight", "averaging")
        self.require_range(0.0, 1.0, "a number from 0 to 1", *shares)
        self.require_range(0.0, math.inf, "a finite number of at least 0", "least_gain")
        self.require_choice("loss", ("smooth_absolute", "squared"))

    @property
    def refinements(self) -> Refinements:
        return self


def epoch_config(config: TwinConfig, policy: TwinPolicy, twin: Twin) -> EpochConfig:
    """
    :param twin: to plan in; its time step determines the default horizon
    :return: static configuration of an epoch
    """
    horizon = config.horizon or int(np.clip(round(_HORIZON / twin.dt), _SHORTEST, _LONGEST))
    how = config.refinements
    return EpochConfig(
        twin=twin,
        actor=policy.actor_network,
        value=policy.value_network,
        n_rollouts=config.n_rollouts,
        horizon=horizon,
        lookahead=_LOOKAHEAD * horizon if config.lookahead is None else config.lookahead,
        advance=(horizon + 1) // 2 if config.reset_share < 1.0 else 0,
        planner=config.planner,
        n_iterations=how.n_iterations,
        n_step_sizes=how.n_step_sizes,
        n_candidates=config.n_random_plans,
        discount=config.gamma,
        terminal_value=config.terminal_value,
        shift_ends=config.shift_ends,
        plan_memory=how.plan_memory,
        n_learned=max(1, round(how.learned_share * horizon)),
        batch_size=config.batch_size,
        squared_error=how.loss == "squared",
        max_grad_norm=policy.max_grad_norm,
        annealed=config.temperature > 0.0,
        adapt_scales=how.adapt_scales,
    )
