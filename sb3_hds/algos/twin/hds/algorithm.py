"""Hybrid differentiable simulation."""

import copy
import dataclasses
from collections.abc import Sequence
from dataclasses import KW_ONLY
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_hds.algos.base.checks import as_list
from sb3_hds.algos.base.config import between, takes
from sb3_hds.algos.twin.algorithm import TwinAlgorithm
from sb3_hds.algos.twin.config import TwinConfig
from sb3_hds.algos.twin.hds.correction import (
    ChangePoint,
    Correction,
    CorrectionConfig,
    correct,
    names_to_estimate,
)
from sb3_hds.algos.twin.hds.recorded_steps import MeasuredSteps, RecordedSteps, data_from
from sb3_hds.algos.twin.hds.windows import force_share_name, no_force
from sb3_hds.algos.twin.planning_twin import missing_effects, nulls_of, require_twin
from sb3_hds.algos.twin.threads import no_poll, run_in_threads
from sb3_hds.core import Effect, Params, Trajectories, Twin
from sb3_hds.core.twin import plant_of
from sb3_hds.effects import ALL, KNOWN, SignFlip, effect_named, reversed_joint
from sb3_hds.errors import TrajectoryError
from sb3_hds.sysid import Diagnosis, Finding, diagnose

# Growth factor of the data after which the force is learned again.
_GROWTH = 2.0
# Planning epochs after a correction that changes the model noticeably: a fifth of the pretraining,
# since most of what was learned in the previous model still holds.
_REPLAN_EPOCHS = 30
# Remaining progress to which learning-rate schedules return after such a correction.
_AGAIN_FROM = 0.5

# Arguments of ``sysid.fit_residual``.
_OF_RESIDUAL = ("n_members", "net_arch", "caution")
_CATALOGUE = {effect.name: effect for effect in ALL}


@dataclasses.dataclass(frozen=True, eq=False)
class HDSConfig(TwinConfig):
    """
    Arguments of HDS.

    :param exploration_decay: factor on the noise after each epoch (the HDS project: 0.5 to 0.99)
    :param temperature: of the annealed acceptance of step sizes and plans, in units of the mean
        gain of the last epoch's plans, times 0.9 after each epoch; 0: always accept the best. The
        HDS project describes it, but does not run it.
    :param calibrated: parameters of the twin and of attached effects to estimate: ``"all"``, names,
        or None
    :param effects: attached to the twin and estimated: names from ``effects.ALL`` (at every joint
        or actuator), or effects
    :param suspected: names of effects that are estimated at every joint or actuator if data show
        that the twin is not exact, and stay where they lower the error; only with
        ``calibrated="all"``. Simulations rarely contain dry friction and command delays, and
        neither other parameters nor a learned force replace them well, see the documentation.
    :param residual_kwargs: of the learned force: ``n_members``, ``net_arch``, ``caution``, see
        ``sysid.fit_residual``
    :param beta: share of rollouts in the model with a learned residual force, if that predicts
        held-out windows better; ``"auto"``: proportional to the improvement, 1 from a quarter on;
        0: no force is learned. The HDS project: 0.05.
    :param refit_freq: blocks of ``train_freq`` between two corrections; 0: no corrections
    :param diagnose_freq: blocks of ``train_freq`` between two diagnoses, which attach the effects
        that they find; 0: no diagnoses
    :param pretrain_data: ``Trajectories``, or a file of them, to correct the model with before the
        first plan. The HDS project: random motion.
    :param first_commands: actions of the first steps of the first episode instead of the policy's,
        such as the experiment that a diagnosis recommends, ``found.next_experiment(...).commands``
        (the first of several recordings), or a file that its ``save`` wrote as ``.npz``; None: the
        policy acts from the first step
    :param max_saved_steps: number of latest measured steps that are saved with the model, then of
        those of ``pretrain_data``; 0: none
    """

    _: KW_ONLY
    exploration_noise: float = 0.25
    exploration_decay: float = 0.997
    temperature: float = 0.05
    calibrated: str | Sequence[str] | None = "all"
    effects: Sequence[str | Effect] = ()
    suspected: Sequence[str] = ("coulomb_friction", "action_delay")
    residual_kwargs: dict[str, Any] | None = None
    beta: float | str = "auto"
    refit_freq: int = 1
    diagnose_freq: int = 0
    pretrain_data: Trajectories | str | None = None
    first_commands: Trajectories | str | None = None
    max_saved_steps: int = 100_000

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_counts({"refit_freq": 0, "diagnose_freq": 0, "max_saved_steps": 0})
        fine = self.beta == "auto" or between(self.beta, 0.0, 1.0)
        self.require(fine, "beta", "'auto' or a number from 0 to 1")
        fine = set(self.residual_kwargs or ()) <= set(_OF_RESIDUAL)
        allowed = f"a dictionary with some of {', '.join(_OF_RESIDUAL)}"
        self.require(fine, "residual_kwargs", allowed)


class HDS(TwinAlgorithm):
    """
    Hybrid differentiable simulation: PODS in a twin that is corrected by measured data.

    It adds to PODS decaying exploration noise, annealed acceptance of step sizes and plans, and a
    correction of the model after each block of real steps: parameters of the twin and of effects
    are estimated jointly, since one can absorb another; then a residual force is learned, again
    whenever the data have doubled; a share ``beta`` of the plans is made in that hybrid model. A
    correction is accepted only if it improves predictions of held-out windows; an exact twin does
    not change.

    Idea: the HDS course project (ETH Zurich, 2024), from its description. Short horizons with a
    learned terminal value, sample weights and averaging are our own; the documentation measures
    their effect.
    """

    config_class = HDSConfig

    @takes(HDSConfig)
    def __init__(self, config: HDSConfig) -> None:
        self.construct(config)

    def construct(self, config: HDSConfig, **more: Any) -> None:  # type: ignore[override]
        # Share of rollouts with the learned force, and the twin's nominal parameters.
        self.model_beta = 0.0
        self.nominal: dict[str, float] = {}
        self.measured = RecordedSteps(self._source, data_from(config.pretrain_data))
        commands = data_from(config.first_commands, "first_commands")
        self._first_commands = None if commands is None else commands.episode(0)[1].tolist()
        # Blocks of real steps; real steps at the last correction, and at the last learned force.
        self._n_blocks, self._refitted_at, self._steps_at_force = 0, 0, 0
        # Real step and recording of the last change of the system; None: it never changed.
        self._changed_at: int | None = None
        self._changed_in = 0
        # Whether ``pretrain_data`` were used; remaining planning epochs after a correction.
        self._saw_earlier = False
        self._replanning = 0
        # Attributes are saved, so they are plain data.
        several = as_list("effects", config.effects, Effect)
        plain = {
            "effects": [e if isinstance(e, str) else e.to_spec() for e in several],
            "suspected": tuple(as_list("suspected", config.suspected, str)),
            "pretrain_data": None,
            "first_commands": None,
        }
        super().construct(dataclasses.replace(config, **plain), **more)
        self._check_first_commands()

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """Correct the model where a correction is due, then plan."""
        self._n_blocks += 1
        diagnose_freq, refit_freq = self.config.diagnose_freq, self.config.refit_freq
        if diagnose_freq and self._n_blocks % diagnose_freq == 0:
            found = self.extend_model()
            self.logger.record("model/diagnosed_effects", len(found.findings) if found else 0)
        if refit_freq and self._n_blocks % refit_freq == 0:
            self.correct_model(gradient_steps)
        super().train(gradient_steps, batch_size)

    def _sample_action(
        self,
        learning_starts: int,
        action_noise: ActionNoise | None = None,
        n_envs: int = 1,
    ) -> tuple[np.ndarray, np.ndarray]:
        step, commands = self.real_timesteps // n_envs, self._first_commands or ()
        if self._episode_num or step >= len(commands):
            return super()._sample_action(learning_starts, action_noise, n_envs)
        space: Any = self.action_space
        action = np.tile(np.array(commands[step], space.dtype), (n_envs, 1))
        action = np.clip(action, space.low, space.high)
        return action, self.policy.scale_action(action)

    def _check_first_commands(self) -> None:
        given = np.shape(self._first_commands or ())[1:]
        # A model that is being loaded has no spaces yet, and no commands.
        if given and self.env is not None and given != (shape := self.action_space.shape):
            raise TrajectoryError(
                f"first_commands are actions of shape {given}, and the environment takes {shape}. "
                "Design them for the twin of this environment."
            )

    def remedies(self, updates_per_step: float) -> list[str]:
        freq = self.config.refit_freq
        own = [f"refit_freq={4 * freq}, {freq} now"] if freq else []
        own += ["beta=0"] if self.config.beta else []
        return own + super().remedies(updates_per_step)

    def before_planning(self) -> None:
        if self.measured.earlier is not None and not self._saw_earlier:
            self.correct_model()
            self._saw_earlier = True

    def correct_model(self, gradient_steps: int = 0) -> Correction | None:
        """
        Correct the twin with all measured data; if that changes it noticeably, plan again.

        :param gradient_steps: regression steps of each of those planning epochs; 0: no epochs
        :return: the correction; None without measured data
        :raises NoTwinError: if the model was loaded without environment and without twin
        """
        data, n_counted = self.measured.recordings(), self._steps_since_change()
        if data is None or self.twin is None:
            return None
        n_steps = data.n_steps if n_counted is None else min(data.n_steps, n_counted)
        by_data = partial(
            correct,
            self.twin,
            data,
            self._correction_config(self.twin),
            self.model_beta,
            learn_force=n_steps >= _GROWTH * self._steps_at_force,
            n_new=self.real_timesteps - self._refitted_at,
            change=None if n_counted is None else ChangePoint(n_counted, self._changed_in),
        )
        correction = by_data() if self.poll is no_poll else run_in_threads([by_data], self.poll)[0]
        if correction.change_point is not None:
            since, self._changed_in = correction.change_point
            self._changed_at, self._steps_at_force = self.real_timesteps - since, 0
            n_steps = min(n_steps, since)
        self._refitted_at = self.real_timesteps
        if correction.residual is not None:
            self._steps_at_force = n_steps
        # Equality ignores values: with another structure, programs are compiled again.
        if correction.twin != self.twin:
            self._workspace = None
        if not correction.twin.same_values(self.twin):
            self.twin_spec = correction.twin.to_spec()
        self.twin, self.model_beta = correction.twin, correction.beta
        self.nominal |= correction.attached
        values, intervals = correction.log()
        for name, value in values.items():
            self.logger.record(name, value)
        for name, value in intervals.items():
            self.logger.record(name, value, exclude="stdout")
        if correction.replan and gradient_steps:
            self._plan_again(gradient_steps)
        return correction

    def _plan_again(self, gradient_steps: int) -> None:
        """Planning epochs in a model that has changed, before the next real step."""
        for remaining in range(_REPLAN_EPOCHS, 0, -1):
            self._replanning = remaining
            super().train(gradient_steps, self.batch_size)
        self._replanning = 0

    def diagnose(self, **arguments: Any) -> Diagnosis:
        """
        Diagnose the nominal twin with the data measured so far.

        :param arguments: of :func:`sb3_hds.diagnose`
        :raises TrajectoryError: without measured data
        :raises NoTwinError: if the model was loaded without environment and without twin
        """
        data = self.measured.trajectories(self._steps_since_change())
        if data is None:
            raise TrajectoryError(
                "Nothing was measured yet. Let the model learn(...) on the real system first."
            )
        twin = require_twin(self.twin, self.twin_spec)
        return diagnose(twin.with_parameters(**self.nominal | no_force(twin)), data, **arguments)

    def extend_model(self, **arguments: Any) -> Diagnosis | None:
        """
        Diagnose the measured data, and attach the effects that are found to the twin.

        Parameters that corrections estimate are nuisance parameters of the diagnosis. The next
        correction estimates the new effects, too, and learns the residual force again.

        :param arguments: of :func:`sb3_hds.diagnose`
        :return: the diagnosis; None without measured data
        """
        if self.twin is None or self.measured.trajectories(self._steps_since_change()) is None:
            return None
        nuisances = names_to_estimate(self.twin, self.config.calibrated)
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
        """:return: whether the twin already has this effect at this location"""
        known = require_twin(self.twin, self.twin_spec).parameters
        return any(name.startswith(f"{effect}.") for name in known)

    def _steps_since_change(self) -> int | None:
        """:return: number of real steps since the last change of the system; None: no change"""
        return None if self._changed_at is None else self.real_timesteps - self._changed_at

    @property
    def comparison_due(self) -> bool:
        """After real steps, the model may have changed: compare policies before one acts."""
        return self.real_timesteps > 0 and not self._replanning

    @property
    def was_compared(self) -> bool:
        """Also before ``compare_every`` epochs: at the end of the first block of real steps."""
        return super().was_compared or self._n_blocks > 1

    def varied(self, twin: Twin) -> Params:
        drawn, share_name = super().varied(twin), force_share_name(twin)
        if share_name is not None:
            n = self.config.n_rollouts
            chosen = np.random.permutation(n) < round(self.model_beta * n)
            drawn[share_name] = jnp.asarray(chosen, jnp.float32)
        return drawn

    def _correction_config(self, twin: Twin) -> CorrectionConfig:
        config = self.config
        return CorrectionConfig(
            names=names_to_estimate(twin, config.calibrated),
            nominal=self.nominal,
            residual_kwargs=config.residual_kwargs or {},
            beta=config.beta,
            seed=config.seed or 0,
            suspected=config.suspected if config.calibrated == "all" else (),
        )

    def _prepare_twin(self, twin: Twin) -> Twin:
        config = self.config
        for name in config.suspected:
            effect_named(name, KNOWN)  # raises if it is unknown
        missing = missing_effects(twin, config.effects)
        twin = twin.extend(*missing) if missing else twin
        if self.twin_spec is None or not self.nominal:
            self.nominal = dict(twin.values)
            names_to_estimate(twin, config.calibrated)
        return twin

    def _source(self) -> MeasuredSteps:
        """The replay buffer, with the step that callbacks received and SB3 has not stored yet."""
        dt = None if self.twin is None else self.twin.dt
        buffer, step = getattr(self, "replay_buffer", None), self.unstored_step
        limit = self.config.max_saved_steps
        if buffer is None or step is None:
            return MeasuredSteps(buffer, dt, self.action_space, limit)
        buffer = copy.copy(buffer)
        if buffer.full:
            # The step would overwrite the oldest one, which the model still has; otherwise, it goes
            # to a row that does not count yet.
            arrays = {n: x.copy() for n, x in vars(buffer).items() if isinstance(x, np.ndarray)}
            vars(buffer).update(arrays)
        before = self._last_obs, self._last_original_obs
        names = {"buffer_actions": "buffer_action", "rewards": "reward"}
        named: Any = {names.get(name, name): value for name, value in step.items()}
        OffPolicyAlgorithm._store_transition(self, buffer, **named)
        self._last_obs, self._last_original_obs = before
        return MeasuredSteps(buffer, dt, self.action_space, limit)

    def _progress_remaining(self) -> float:
        remaining = super()._progress_remaining()
        if not self._replanning:
            return remaining
        return max(remaining, _AGAIN_FROM * self._replanning / _REPLAN_EPOCHS)

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        names, variables = super()._get_torch_save_params()
        return [*names, "measured"], variables

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "measured", "_first_commands"]


def _native_of(finding: Finding, found: Twin) -> dict[str, float]:
    """:return: values of the twin's own parameters that describe the effect, if there are any"""
    place = finding.effect, int(finding.where["index"])
    names = plant_of(found).native_effects.get(place, {}).values()
    return {name: found.values[name] for name in names}


def _effects_of(finding: Finding, twin: Twin) -> list[Effect]:
    """:return: the effect with its estimated parameters; several for a reversed joint"""
    if finding.effect == SignFlip.name and finding.where["slot"] == "joint":
        return list(reversed_joint(twin, int(finding.where["index"])))
    values = {name: found.estimate for name, found in finding.parameters.items()}
    return [_CATALOGUE[finding.effect](finding.where["name"], **values)]
