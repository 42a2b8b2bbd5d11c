"""Shared control templates: a task in phases, each with few inputs and its own constraints."""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces

from sb3_hds.core import Channel
from sb3_hds.errors import ParameterError, SafetyError
from sb3_hds.wrappers.action_layer import ActionLayer, with_channels
from sb3_hds.wrappers.by_name import function_of
from sb3_hds.wrappers.observations import is_vector
from sb3_hds.wrappers.safety.barrier import refuse_layers_below
from sb3_hds.wrappers.safety.shield import Constraints, ConstraintSet, nearest


@dataclasses.dataclass(frozen=True)
class Phase:
    """
    One phase of a task.

    :param name: unique within the template
    :param mapping: from inputs to commands, a matrix of shape ``(n_commands, n_inputs)``; or a
        function of the observation that returns one, or its name ``"package.module.function"``
    :param offset: command at zero input, shape ``(n_commands,)``; default: zero
    :param constraints: of this phase, as for :class:`ActionShield`; None: none
    :param transitions: ``{"to": NAME, "when": CONDITION}``; the first whose condition holds after a
        step is taken. A condition is a function of the observation, its name, or ``{"channel":
        INDEX, "above": VALUE}`` (or ``"below"``)
    """

    name: str
    mapping: Any
    offset: Sequence[float] | None = None
    constraints: Constraints | None = None
    transitions: Sequence[Mapping[str, Any]] = ()


class SharedControlTemplate(ActionLayer):
    r"""
    A state machine of a task. In each phase, a few inputs in [-1, 1] are mapped to commands,
    :math:`u = M(o)\,a + c`, and projected onto the constraints of the phase; conditions on
    observations lead from phase to phase. The policy learns the inputs only, and constraints are
    enforced rather than rewarded.

    The phase is appended to observations, one-hot. ``info["phase"]`` is its name. Learners store
    the raw action, because a command has no unique input.

    Assumes that some command is allowed at every observation of a phase. The template must be next
    to the environment: a layer below it would change its commands.

    Source: the idea of shared control templates as in Quere et al., *Shared control templates for
    assistive robotics*, ICRA 2020, and Padalkar et al., *Guiding reinforcement learning with shared
    control templates*, ICRA 2023; the formulation here, with linear constraints, is our own.

    :param env: its observations are a Box with one axis, its actions a bounded one
    :param phases: :class:`Phase` each, or its arguments; an episode begins in the first
    :param observe_state: whether the phase is appended; without it, the task is not Markov
    :param store: ``"raw"``
    :raises ParameterError: for phases that do not fit each other or the environment
    """

    stores: ClassVar[tuple[str, ...]] = ("raw",)

    def __init__(
        self,
        env: gymnasium.Env,
        phases: Sequence[Phase | Mapping[str, Any]],
        *,
        observe_state: bool = True,
        store: str = "raw",
    ) -> None:
        refuse_layers_below(type(self), env)
        super().__init__(env, store, phases=phases, observe_state=observe_state)
        self.phases = [_phase_of(phase) for phase in phases]
        self._observes, self._index, self._seen = observe_state, 0, None
        self._violated = 0.0
        self._phase_of = {phase.name: i for i, phase in enumerate(self.phases)}
        if len(self._phase_of) != len(self.phases) or not self.phases:
            raise ParameterError(f"Phases need unique names: {[p.name for p in self.phases]}.")
        self._compiled = [_Compiled(phase, env, self._phase_of) for phase in self.phases]
        n_inputs = {phase.n_inputs for phase in self._compiled if phase.n_inputs is not None}
        if len(n_inputs) != 1:
            raise ParameterError(
                f"All phases must map the same number of inputs, got {sorted(n_inputs)}: pad "
                "mappings with columns of zeros, and give at least one phase a constant mapping."
            )
        self.action_space = spaces.Box(-1.0, 1.0, (n_inputs.pop(),), np.float32)
        if observe_state:
            flags = tuple(Channel(f"phase {phase.name}", "1", 0.0, 1.0) for phase in self.phases)
            self.observation_space = with_channels(self, env.observation_space, flags)

    @property
    def phase(self) -> str:
        """Name of the current phase."""
        return self.phases[self._index].name

    def nominal(self, action: np.ndarray) -> np.ndarray:
        phase = self._compiled[self._index]
        command = phase.matrix(self._seen) @ np.clip(action, -1.0, 1.0) + phase.offset
        return np.clip(command, self.commands.low, self.commands.high)

    def decide(self, action: np.ndarray) -> np.ndarray:
        wanted, phase = self.nominal(action), self._compiled[self._index]
        if phase.constraints is None:
            return wanted
        ends = self.commands.low.astype(float), self.commands.high.astype(float)
        command = nearest(wanted, *phase.constraints.at(self._seen), *ends)
        if command is None:
            raise SafetyError(
                f"No command satisfies the constraints of phase '{self.phase}' at the observation "
                f"{self._seen}. Loosen them, or leave the phase before."
            )
        return command

    def begin(self, obs: Any) -> None:
        super().begin(obs)
        self._index, self._violated = 0, 0.0
        self._transition(obs)

    def observe(self, obs: Any, command: np.ndarray) -> None:
        super().observe(obs, command)
        constraints, self._violated = self._compiled[self._index].constraints, 0.0
        if constraints is not None:
            G, h = constraints.at(self._seen)
            self._violated = float(np.clip(G @ command - h, 0.0, None).sum())
        self._transition(obs)

    def observation(self, obs: Any) -> Any:
        if not self._observes:
            return obs
        flags = np.arange(len(self.phases)) == self._index
        return np.concatenate([obs, flags]).astype(self.observation_space.dtype)

    def cost(self) -> float:
        return self._violated

    def extra_info(self) -> dict[str, Any]:
        return {"phase": self.phase}

    def _transition(self, obs: Any) -> None:
        self._seen = obs
        for condition, following in self._compiled[self._index].transitions:
            if condition(obs):
                self._index = following
                return


def _phase_of(given: Any) -> Phase:
    """:raises ParameterError: for arguments that a phase does not have"""
    if isinstance(given, Phase):
        return given
    names = [field.name for field in dataclasses.fields(Phase)]
    found = set(given) if isinstance(given, Mapping) else set()
    if not {"name", "mapping"} <= found <= set(names):
        raise ParameterError(
            f"A phase is a dictionary with 'name' and 'mapping' and, if needed, "
            f"{', '.join(map(repr, names[2:]))}, got {given!r}."
        )
    return Phase(**given)


class _Compiled:
    """A phase with its names resolved to functions and indices."""

    def __init__(self, phase: Phase, env: gymnasium.Env, phases: Mapping[str, int]) -> None:
        assert env.action_space.shape is not None
        self._n = env.action_space.shape[0]
        self._phase = phase.name
        self._mapping = (
            function_of(phase.mapping) if isinstance(phase.mapping, str) else phase.mapping
        )
        fixed = None if callable(self._mapping) else self._checked(self._mapping, ParameterError)
        self._fixed, self.n_inputs = fixed, None if fixed is None else fixed.shape[1]
        self.offset = np.zeros(self._n) if phase.offset is None else np.array(phase.offset, float)
        if self.offset.shape != (self._n,):
            raise ParameterError(
                f"Phase '{phase.name}' has the offset {phase.offset!r} for {self._n} commands."
            )
        self.constraints: ConstraintSet | None = None
        if phase.constraints is not None:
            label = f"Phase '{phase.name}'"
            self.constraints = ConstraintSet(label, phase.constraints, self._n)
            self._check_feasible(env.action_space)
        seen = env.observation_space
        n_obs = seen.shape[0] if is_vector(seen) else 0
        for transition in phase.transitions:
            if not isinstance(transition, Mapping) or set(transition) != {"to", "when"}:
                raise ParameterError(
                    f"Phase '{phase.name}' has the transition {transition!r}: it needs 'to', the "
                    "name of a phase, and 'when', a condition, and nothing else."
                )
        unknown = [t["to"] for t in phase.transitions if t["to"] not in phases]
        if unknown:
            raise ParameterError(
                f"Phase '{phase.name}' leads to {unknown}, but there are: {list(phases)}."
            )
        self.transitions = [
            (_condition_of(t["when"], n_obs), phases[t["to"]]) for t in phase.transitions
        ]

    def _check_feasible(self, commands: spaces.Space) -> None:
        assert isinstance(commands, spaces.Box) and self.constraints is not None
        if not self.constraints.is_constant:
            return
        ends = commands.low.astype(float), commands.high.astype(float)
        if nearest(np.zeros(self._n), *self.constraints.at(None), *ends) is None:
            raise ParameterError(
                f"No command between {ends[0].tolist()} and {ends[1].tolist()} satisfies the "
                f"constraints of phase '{self._phase}'."
            )

    def matrix(self, obs: Any) -> np.ndarray:
        """:return: from inputs to commands, shape ``(n_commands, n_inputs)``"""
        return self._checked(self._mapping(obs), ValueError) if self._fixed is None else self._fixed

    def _checked(self, matrix: Any, error: type[Exception]) -> np.ndarray:
        try:
            found = np.asarray(matrix, float)
        except (TypeError, ValueError):
            found = np.empty(())
        if found.ndim != 2 or len(found) != self._n or not np.isfinite(found).all():
            raise error(
                f"Phase '{self._phase}' needs a finite mapping of shape ({self._n}, n_inputs), got "
                f"{matrix!r}."
            )
        return found


def _condition_of(given: Any, n_obs: int) -> Callable[[Any], Any]:
    """
    :param given: a function of the observation, its name, or ``{"channel": 0, "above": 0.5}`` with
        ``above``, ``below`` or both
    :raises ParameterError: for anything else
    """
    if isinstance(given, str):
        return function_of(given)
    if not isinstance(given, Mapping) and callable(given):
        return given
    known = isinstance(given, Mapping) and {"channel"} < set(given) <= {"channel", "above", "below"}
    if not known or given["channel"] not in range(n_obs):
        raise ParameterError(
            "A condition is a function of the observation, its name, or {'channel': INDEX, "
            f"'above': VALUE}} (or 'below') with an index below {n_obs}; got {given!r}."
        )
    low, high = float(given.get("above", -math.inf)), float(given.get("below", math.inf))
    return functools.partial(_is_between, channel=given["channel"], low=low, high=high)


def _is_between(obs: Any, channel: int, low: float, high: float) -> bool:
    return bool(low < obs[channel] < high)
