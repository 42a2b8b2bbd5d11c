"""Hybrid differentiable simulation."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import LinearSchedule

from sb3_hds.algos.base.checks import as_list
from sb3_hds.algos.twin.algorithm import TwinAlgorithm
from sb3_hds.algos.twin.hds.correction import Correction, Since, Wishes, correct, names_to_estimate
from sb3_hds.algos.twin.hds.recorded_steps import Measured, data_from
from sb3_hds.algos.twin.log import record_correction
from sb3_hds.algos.twin.model import check_known, missing_effects, nulls_of, required
from sb3_hds.algos.twin.pretraining import meanwhile, nothing
from sb3_hds.core import Effect, Params, Trajectories, Twin
from sb3_hds.core.twin import plant_of
from sb3_hds.effects import ALL, SignFlip, force_of, reversed_joint
from sb3_hds.errors import TrajectoryError
from sb3_hds.sysid import Diagnosis, Finding, diagnose

# The learned force is learned again when the data have grown by this factor.
_GROWTH = 2.0
# Where the model has changed, learning rates go back to this point of their schedule.
_AGAIN_FROM = 0.5

_CATALOGUE = {effect.name: effect for effect in ALL}


class HDS(TwinAlgorithm):
    """
    Hybrid differentiable simulation: PODS on a model that measured data keep correcting.

    What it adds to PODS: exploration noise that decays, annealed acceptance of step sizes, plans
    that start where the real environment was seen; and after each block of real steps, the model is
    corrected by what the environment answered: parameters of the twin and of effects are estimated
    together, since one can stand for another; then a force is learned for what remains, again
    whenever the data have doubled, and a share ``beta`` of the plans is made in that hybrid.
    Nothing is kept that does not predict held-out windows of the data better; a twin that is exact
    is left alone.

    Idea: the HDS course project (ETH Zurich, 2024), from its description; planning by short
    horizons with a learned tail, weights and averaging are our own, see the documentation for what
    each gains.

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
    :param exploration_decay: factor on the noise after each epoch (the HDS project: 0.5 to 0.99)
    :param temperature: of the annealed acceptance of step sizes and plans, in units of the mean
        gain of the last epoch's plans; 0 takes the best always. The HDS project describes it and
        does not run it.
    :param temperature_decay: factor on the temperature after each epoch
    :param relabel_share: share of plans that start in states in which the real environment was seen
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
        paper). Between real steps every epoch counts, but for those that follow a correction.
    :param least_gain: the pretraining ends when plans have gained less than this share of the
        policy's return, on the average of about ten epochs; 0: never
    :param randomisation: domain randomisation: standard deviation of the twin's parameters between
        rollouts, in units of each parameter's ``scale``; 0: none
    :param calibrated: parameters of the twin, and of attached effects, that data correct:
        ``"all"``, names, or None
    :param effects: attached to the twin, so that data can inform them: names from ``effects.ALL``
        (then at every joint or actuator), or effects
    :param suspected: names of effects that are estimated, at every joint or actuator, once data
        show that the twin is not exact, and stay where they explain something; only with
        ``calibrated="all"``. Dry friction and late commands are rarely in a simulation, and neither
        another parameter nor a learned force stands for them well, see the documentation.
    :param residual: whether a force is learned for what remains
    :param residual_kwargs: ``n_members``, ``net_arch``, ``caution``, see ``sysid.fit_residual``
    :param beta: share of rollouts in the model with the learned force, where that predicts held-out
        windows better than the model without; ``"auto"``: in proportion to how much better, all of
        them from a quarter on. The HDS project: 0.05.
    :param refit_freq: blocks of ``train_freq`` from one correction to the next; 0: never
    :param replan_epochs: planning epochs after a correction that changes the model noticeably
    :param diagnose_freq: blocks of ``train_freq`` from one diagnosis to the next, which attaches
        the effects that the data name; 0: never
    :param pretrain_data: ``Trajectories``, or a file of them, from which the model is corrected
        before the first plan. The HDS project: random motion.
    :param save_data: whether the measured steps are saved with the model
    :param max_saved_steps: how many of them, the latest; those of ``pretrain_data`` where there is
        room left
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
        exploration_noise: float = 0.25,
        exploration_decay: float = 0.997,
        temperature: float = 0.05,
        temperature_decay: float = 0.9,
        relabel_share: float = 0.0,
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
        calibrated: str | Sequence[str] | None = "all",
        effects: Sequence[str | Effect] = (),
        suspected: Sequence[str] = ("coulomb_friction", "action_delay"),
        residual: bool = True,
        residual_kwargs: dict[str, Any] | None = None,
        beta: float | str = "auto",
        refit_freq: int = 1,
        replan_epochs: int = 30,
        diagnose_freq: int = 0,
        pretrain_data: Trajectories | str | None = None,
        save_data: bool = True,
        max_saved_steps: int = 100_000,
        policy_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        device: str = "auto",
        seed: int | None = None,
        monitor_wrapper: bool = True,
        _init_setup_model: bool = True,
    ) -> None:
        self.calibrated = calibrated
        several = as_list("effects", effects, Effect)
        self.effects = [e if isinstance(e, str) else e.to_spec() for e in several]
        self.suspected = tuple(as_list("suspected", suspected, str))
        self.residual = residual
        self.residual_kwargs = residual_kwargs
        self.beta = beta
        self.refit_freq = refit_freq
        self.replan_epochs = replan_epochs
        self.diagnose_freq = diagnose_freq
        self.save_data = save_data
        self.max_saved_steps = max_saved_steps
        self.model_beta = 0.0
        self.nominal: dict[str, float] = {}
        self.measured = Measured(self, data_from(pretrain_data))
        self._n_blocks, self._refitted_at, self._steps_at_force = 0, 0, 0
        self._changed_at: int | None = None
        self._changed_in = 0
        self._saw_earlier = False
        self._replanning = 0
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
            exploration_decay=exploration_decay,
            temperature=temperature,
            temperature_decay=temperature_decay,
            relabel_share=relabel_share,
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

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """Correct the model where a correction is due, then plan."""
        self._n_blocks += 1
        if self.diagnose_freq and self._n_blocks % self.diagnose_freq == 0:
            found = self.extend_model()
            self.logger.record("model/diagnosed_effects", len(found.findings) if found else 0)
        if self.refit_freq and self._n_blocks % self.refit_freq == 0:
            self.correct_model(gradient_steps)
        super().train(gradient_steps, batch_size)

    def remedies(self, updates_per_step: float) -> list[str]:
        own = (
            [f"refit_freq={4 * self.refit_freq}, {self.refit_freq} now"] if self.refit_freq else []
        )
        own += ["residual=False"] if self.residual else []
        return own + super().remedies(updates_per_step)

    def before_planning(self) -> None:
        if self.measured.earlier is not None and not self._saw_earlier:
            self.correct_model()
            self._saw_earlier = True

    def correct_model(self, gradient_steps: int = 0) -> Correction | None:
        """
        Correct the twin by all that was measured; where that changes it noticeably, plan anew.

        :param gradient_steps: regression steps of each of those planning epochs; 0: no epochs
        :return: what the data say; None before anything was measured
        :raises NoTwinError: if the model was loaded without environment and without twin
        """
        data, n_counted = self.measured.recordings(), self._since_change()
        if data is None or self.twin is None:
            return None
        n_steps = data.n_steps if n_counted is None else min(data.n_steps, n_counted)
        by_data = partial(
            correct,
            self.twin,
            data,
            self._wishes(self.twin),
            self.model_beta,
            learn_force=n_steps >= _GROWTH * self._steps_at_force,
            n_new=self.real_timesteps - self._refitted_at,
            since=None if n_counted is None else Since(n_counted, self._changed_in),
        )
        found = by_data() if self.poll is nothing else meanwhile([by_data], self.poll)[0]
        if found.since is not None:
            self._changed_at = self.real_timesteps - found.since.n_steps
            self._changed_in, self._steps_at_force = found.since.recording, 0
        self._refitted_at = self.real_timesteps
        if found.residual is not None:
            self._steps_at_force = n_steps
        if found.twin != self.twin:
            self._workspace = None
        if found.twin != self.twin or found.twin.values != self.twin.values:
            self.twin_spec = found.twin.to_spec()
        self.twin, self.model_beta = found.twin, found.beta
        self.nominal |= found.attached
        record_correction(self, found)
        if found.changed and gradient_steps:
            for left in range(self.replan_epochs, 0, -1):
                self._replanning = left
                super().train(gradient_steps, self.batch_size)
            self._replanning = 0
        return found

    def diagnose(self, **arguments: Any) -> Diagnosis:
        """
        What the data measured so far say about the twin as it was before any of them.

        :param arguments: as of :func:`sb3_hds.diagnose`
        :raises TrajectoryError: before anything was measured
        :raises NoTwinError: if the model was loaded without environment and without twin
        """
        data = self.measured.trajectories(self._since_change())
        if data is None:
            raise TrajectoryError(
                "Nothing was measured yet. Let the model learn(...) on the real system first."
            )
        force = force_of(twin := required(self.twin, self.twin_spec))
        silent = {} if force is None else {f"{force[0]}.share": 0.0}
        return diagnose(twin.with_parameters(**self.nominal | silent), data, **arguments)

    def extend_model(self, **arguments: Any) -> Diagnosis | None:
        """
        Diagnose what was measured, and attach the effects that the data name to the twin.

        Parameters that corrections estimate anyway are no findings here. The next correction
        estimates the new effects with them, and learns the remaining force anew.

        :param arguments: as of :func:`sb3_hds.diagnose`
        :return: what the data say; None before anything was measured
        """
        if self.twin is None or self.measured.trajectories(self._since_change()) is None:
            return None
        nuisances = names_to_estimate(self.twin, self.calibrated)
        own = {"budget": "quick", "progress": False, "calibrate": nuisances} | arguments
        found = self.diagnose(**own)
        new = [
            f
            for f in found.findings
            if f.effect in _CATALOGUE and not self._estimates(f"{f.effect}.{f.where['name']}")
        ]
        values, causes = {}, []
        for f in new:
            native = _native_of(f, found.twin)
            values |= native
            causes += [] if native else _effects_of(f, self.twin)
        if new:
            twin = self.twin.with_parameters(**values)
            self.twin = twin.extend(*causes) if causes else twin
            self.nominal |= nulls_of(causes) | values
            self.twin_spec, self._workspace = self.twin.to_spec(), None
            self._steps_at_force = 0
        return found

    def _estimates(self, effect: str) -> bool:
        """:return: whether the twin has this effect at this place already"""
        known = required(self.twin, self.twin_spec).parameters
        return any(name.startswith(f"{effect}.") for name in known)

    def _since_change(self) -> int | None:
        """:return: real steps that count, where the system changed; None if all do"""
        return None if self._changed_at is None else self.real_timesteps - self._changed_at

    @property
    def comparison_due(self) -> bool:
        """What was better in another model need not be so in this one: before it acts, compare."""
        return self.real_timesteps > 0 and not self._replanning

    def varied(self, twin: Twin) -> Params:
        drawn, force = super().varied(twin), force_of(twin)
        if force is not None:
            n_hybrid = round(self.model_beta * self.n_rollouts)
            chosen = np.random.permutation(self.n_rollouts) < n_hybrid
            drawn[f"{force[0]}.share"] = jnp.asarray(chosen, jnp.float32)
        return drawn

    def _wishes(self, twin: Twin) -> Wishes:
        return Wishes(
            names=names_to_estimate(twin, self.calibrated),
            nominal=self.nominal,
            residual=self.residual,
            residual_kwargs=self.residual_kwargs or {},
            beta=self.beta,
            seed=self.seed or 0,
            suspected=self.suspected if self.calibrated == "all" else (),
        )

    def _prepared(self, twin: Twin) -> Twin:
        check_known(self.suspected)
        missing = missing_effects(twin, self.effects)
        twin = twin.extend(*missing) if missing else twin
        if self.twin_spec is None or not self.nominal:
            self.nominal = dict(twin.values)
            names_to_estimate(twin, self.calibrated)
        return twin

    def _progress_remaining(self) -> float:
        remaining = super()._progress_remaining()
        if not self._replanning:
            return remaining
        return max(remaining, _AGAIN_FROM * self._replanning / self.replan_epochs)

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        names, variables = super()._get_torch_save_params()
        return [*names, "measured"], variables

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "measured"]


def _native_of(finding: Finding, found: Twin) -> dict[str, float]:
    """:return: values of the twin's own parameters that stand for the effect, if it has any"""
    place = finding.effect, int(finding.where["index"])
    names = plant_of(found).native_effects.get(place, {}).values()
    return {name: found.values[name] for name in names}


def _effects_of(finding: Finding, twin: Twin) -> list[Effect]:
    """:return: the named effect as the data have it; of a joint the wrong way round, several"""
    if finding.effect == SignFlip.name and finding.where["slot"] == "joint":
        return list(reversed_joint(twin, int(finding.where["index"])))
    values = {name: found.estimate for name, found in finding.parameters.items()}
    return [_CATALOGUE[finding.effect](finding.where["name"], **values)]
