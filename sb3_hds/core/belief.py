"""A twin with uncertain parameters."""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from sb3_hds.core.effect import Effect
from sb3_hds.core.effect_chain import NO_EFFECTS, EffectChain
from sb3_hds.core.trajectories.storage import check_target, write_bytes
from sb3_hds.core.twin import Layer, State, Twin
from sb3_hds.core.types import Action, Obs, Params
from sb3_hds.errors import ParameterError

# Key of an episode's draw in the state's memory, and of all draws in the tensors.
_DRAW, _DRAWS = "belief", "belief.draws"


class BeliefTwin(Layer):
    """
    Equally likely parameter vectors of one twin. :meth:`initial` draws one, and it stays in the
    state's memory: every rollout, and every environment until its next reset, simulates one draw.
    Planning, learning and environments need no change.

    A state that is inferred from an observation gets draw 0, the best single estimate. Parameters
    that are equal in all draws are those of the twin; the others are in the draws only.

    :param base: the twin with the effects of all draws
    :param draws: one parameter vector per row, in the order of ``base.parameters``, shape
        ``(n, p)``; the first is the best single estimate
    :param origin: index of the answer that each draw comes from, shape ``(n,)``
    :param answers: names of the answers of a diagnosis
    :param weights: probabilities of the answers, with the sum one
    :raises ParameterError: for a wrong shape, or a value that is not finite or out of bounds
    """

    def __init__(
        self,
        base: Twin,
        draws: Float[np.ndarray, "n p"],
        origin: Int[np.ndarray, " n"] | None = None,
        answers: Sequence[str] = ("the twin",),
        weights: Sequence[float] = (1.0,),
    ) -> None:
        draws = np.asarray(draws, float)
        origin = np.zeros(len(draws), int) if origin is None else np.asarray(origin, int)
        _check(base, draws, origin, answers, weights)
        self.base = base
        self._copy_declarations(base)
        own = dict(zip(base.parameters, draws.T, strict=True))
        self.varied = tuple(name for name, column in own.items() if np.ptp(column) > 0.0)
        shared = [name for name in own if name not in self.varied]
        self.parameters = {name: base.parameters[name] for name in shared}
        self.values = {name: float(own[name][0]) for name in shared}
        self.known_parameters = base.known_parameters & frozenset(shared)
        self._varied_draws = draws[:, [name in self.varied for name in own]]
        self.origin = origin
        self.answers, self.weights = tuple(answers), tuple(map(float, weights))
        self.tensors = {**base.tensors, _DRAWS: jnp.asarray(self._varied_draws, jnp.float32)}

    @property
    def n_draws(self) -> int:
        """Number of draws."""
        return len(self._varied_draws)

    @property
    def draws(self) -> Float[np.ndarray, "n p"]:
        """All parameters, one vector per row, in the order of ``base.parameters``."""
        own = dict(zip(self.varied, self._varied_draws.T, strict=True))
        columns = [own.get(n, self.values.get(n)) for n in self.base.parameters]
        return np.stack([np.broadcast_to(x, self.n_draws) for x in columns], 1)

    def member(self, i: int) -> Twin:
        """
        :param i: index of a draw; 0: the best single estimate
        :return: the twin with the parameters of that draw
        """
        values = zip(self.base.parameters, self.draws[i].tolist(), strict=True)
        return self.base.with_parameters(**dict(values))

    def __str__(self) -> str:
        """The answers with their weights, and quantiles of the parameters that vary."""
        lines = [f"Belief about {self.name}: {self.n_draws} draws"]
        lines += [
            f"  {weight:6.1%}  {answer}"
            for answer, weight in zip(self.answers, self.weights, strict=True)
        ]
        if self.varied:
            lines.append(f"{'parameter':<38}{'best':>10}{'5 %':>10}{'95 %':>10}")
        for name, column in zip(self.varied, self._varied_draws.T, strict=True):
            unit = self.base.parameters[name].unit
            low, high = np.quantile(column, [0.05, 0.95])
            lines.append(f"{name[-38:]:<38}{column[0]:>10.4g}{low:>10.4g}{high:>10.4g} {unit}")
        return "\n".join(lines)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """
        Write a JSON file for ``twins.from_spec`` and ``--twin``.

        :param path: a file of that name is replaced
        :return: the path
        :raises OSError: if its folder does not exist
        """
        check_target(path)
        return write_bytes(path, (json.dumps({"twin": self.to_spec()}) + "\n").encode())

    def extend(self, *effects: Effect) -> "BeliefTwin":
        extended = self.base.extend(*effects)
        own = dict(zip(self.base.parameters, self.draws.T, strict=True))
        columns = [own.get(n, extended.values[n]) for n in extended.parameters]
        draws = np.stack([np.broadcast_to(x, self.n_draws) for x in columns], 1)
        return self._with_base(extended, draws)

    def without(self, *keys: str) -> "BeliefTwin":
        reduced = self.base.without(*keys)
        kept = [name in reduced.parameters for name in self.base.parameters]
        return self._with_base(reduced, self.draws[:, kept])

    def at_interval(self, dt: float, substeps: int) -> "BeliefTwin":
        return self._with_base(self.base.at_interval(dt, substeps), self.draws)

    def initial(self, key: PRNGKeyArray, params: Params) -> State:
        key, own = jax.random.split(key)
        draw = jax.random.randint(own, (), 0, len(params[_DRAWS]))
        return self._with_draw(draw, self.base.initial(key, self._drawn_params(draw, params)))

    def infer(self, obs: Obs, params: Params) -> State:
        draw = jnp.zeros((), int)
        return self._with_draw(draw, self.base.infer(obs, self._drawn_params(draw, params)))

    def observe(self, state: State, params: Params) -> Obs:
        return self.base.observe(self.inner_state(state), self.inner_params(state, params))

    def step(
        self, state: State, action: Action, params: Params, effects: EffectChain = NO_EFFECTS
    ) -> State:
        own = self.inner_params(state, params)
        after = self.base.step(self.inner_state(state), action, own, effects)
        return after._replace(memory=after.memory | {_DRAW: state.memory[_DRAW]})

    def to_spec(self) -> dict[str, Any]:
        belief = {
            "parameters": list(self.base.parameters),
            "draws": self.draws.tolist(),
            "origin": self.origin.tolist(),
            "answers": list(self.answers),
            "weights": list(self.weights),
        }
        return self.base.with_parameters(**self.values).to_spec() | {"belief": belief}

    def structure(self) -> tuple[Any, ...]:
        return (type(self), self.base, self.varied)

    def __repr__(self) -> str:
        return f"BeliefTwin({self.base!r}, {self.n_draws} draws)"

    def _with_base(self, base: Twin, draws: np.ndarray) -> "BeliefTwin":
        return BeliefTwin(base, draws, self.origin, self.answers, self.weights)

    def _drawn_params(self, draw: Any, params: Params) -> Params:
        own = params[_DRAWS][draw]
        drawn = {name: own[i] for i, name in enumerate(self.varied)}
        return {name: params[name] for name in (*self.values, *self.base.tensors)} | drawn

    def inner_state(self, state: State) -> State:
        memory = {key: own for key, own in state.memory.items() if key != _DRAW}
        return state._replace(memory=memory)

    def inner_params(self, state: State, params: Params) -> Params:
        draw = jax.lax.stop_gradient(state.memory[_DRAW])
        return self._drawn_params(jnp.round(draw).astype(int), params)

    def _with_draw(self, draw: Any, state: State) -> State:
        return state._replace(memory=state.memory | {_DRAW: draw.astype(state.q.dtype)})


def belief_from_spec(base: Twin, spec: Mapping[str, Any]) -> BeliefTwin:
    """
    :param spec: what ``to_spec`` wrote as ``"belief"``
    :raises ParameterError: for other parameters than the twin's, or invalid draws
    """
    names, stored = list(base.parameters), list(spec["parameters"])
    if sorted(stored) != sorted(names):
        raise ParameterError(
            f"The belief is about {', '.join(stored)}, and {base.name} has {', '.join(names)}: it "
            "belongs to another twin."
        )
    draws = np.asarray(spec["draws"], float)[:, [stored.index(name) for name in names]]
    return BeliefTwin(base, draws, np.asarray(spec["origin"]), spec["answers"], spec["weights"])


def _check(
    base: Twin,
    draws: np.ndarray,
    origin: np.ndarray,
    answers: Sequence[str],
    weights: Sequence[float],
) -> None:
    names = tuple(base.parameters)
    if draws.ndim != 2 or not len(draws) or draws.shape[1] != len(names):
        raise ParameterError(
            f"Draws of {base.name} are rows of {len(names)} numbers ({', '.join(names)}), got an "
            f"array of shape {draws.shape}."
        )
    fits = origin.shape == (len(draws),) and len(answers) == len(weights)
    if not (fits and np.all((origin >= 0) & (origin < len(answers)))):
        raise ParameterError(
            f"origin must be the index of one of {len(answers)} answers for each of "
            f"{len(draws)} draws, got shape {origin.shape}."
        )
    for name, column in zip(names, draws.T, strict=True):
        for value in (column.min(), column.max()):
            base.parameters[name].check(name, value)
