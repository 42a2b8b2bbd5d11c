"""A twin of which several are possible, which is again a twin."""

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

#: under which the state remembers its draw, and the tensor that holds all of them
_DRAW, _DRAWS = "belief", "belief.draws"


class BeliefTwin(Layer):
    """
    Equally likely parameter vectors of one twin. Each episode has its own: it is drawn where the
    episode begins (:meth:`initial`), and stays in the state's memory. Planning, learning and
    environments need not know of it: every rollout, and every environment until its next reset, is
    under one draw.

    A state that is inferred from an observation is under draw 0, the best single guess. What is the
    same in all draws is a parameter as of any twin; what differs is in the draws alone.

    :param base: the twin with everything that any draw has
    :param draws: by row, the parameters in the order of ``base.parameters``, shape ``(n, p)``; the
        first is the best single guess
    :param origin: number of the answer that each draw comes from, shape ``(n,)``
    :param answers: their names
    :param weights: their shares, with the sum one
    :raises ParameterError: for a wrong shape, a value that is not finite or out of its bounds
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
        self._mirror(base)
        own = dict(zip(base.parameters, draws.T, strict=True))
        self.varied = tuple(name for name, column in own.items() if np.ptp(column) > 0.0)
        shared = [name for name in own if name not in self.varied]
        self.parameters = {name: base.parameters[name] for name in shared}
        self.values = {name: float(own[name][0]) for name in shared}
        self.known_parameters = base.known_parameters & frozenset(shared)
        self._differing = (
            np.stack([own[name] for name in self.varied], 1)
            if self.varied
            else (np.zeros((len(draws), 0)))
        )
        self.origin = origin
        self.answers, self.weights = tuple(answers), tuple(map(float, weights))
        self.tensors = {**base.tensors, _DRAWS: jnp.asarray(self._differing, jnp.float32)}

    @property
    def n_draws(self) -> int:
        """Their number."""
        return len(self._differing)

    @property
    def draws(self) -> Float[np.ndarray, "n p"]:
        """All parameters by row, in the order of ``base.parameters``."""
        own = dict(zip(self.varied, self._differing.T, strict=True))
        same = np.ones(self.n_draws)
        return np.stack(
            [own.get(n, self.values.get(n, 0.0) * same) for n in self.base.parameters], 1
        )

    def member(self, i: int) -> Twin:
        """
        :param i: number of a draw; 0: the best single guess
        :return: the twin of that draw
        """
        values = zip(self.base.parameters, self.draws[i].tolist(), strict=True)
        return self.base.with_parameters(**dict(values))

    def __str__(self) -> str:
        """The answers with their weights, and the parameters that differ between draws."""
        lines = [f"Belief about {self.name}: {self.n_draws} draws"]
        lines += [
            f"  {weight:6.1%}  {answer}"
            for answer, weight in zip(self.answers, self.weights, strict=True)
        ]
        if self.varied:
            lines.append(f"{'parameter':<38}{'best':>10}{'5 %':>10}{'95 %':>10}")
        for name, column in zip(self.varied, self._differing.T, strict=True):
            unit = self.base.parameters[name].unit
            low, high = np.quantile(column, [0.05, 0.95])
            lines.append(f"{name[-38:]:<38}{column[0]:>10.4g}{low:>10.4g}{high:>10.4g} {unit}")
        return "\n".join(lines)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """
        Write the belief as plain data, for ``twins.from_spec`` and ``--twin``.

        :param path: a file of that name is replaced as a whole
        :return: its path
        :raises OSError: if there is no folder to write it in
        """
        check_target(path)
        return write_bytes(path, (json.dumps({"twin": self.to_spec()}) + "\n").encode())

    def extend(self, *effects: Effect) -> "BeliefTwin":
        extended = self.base.extend(*effects)
        own = dict(zip(self.base.parameters, self.draws.T, strict=True))
        same = np.ones(self.n_draws)
        columns = [own.get(n, extended.values[n] * same) for n in extended.parameters]
        return self._over(extended, np.stack(columns, 1))

    def without(self, *keys: str) -> "BeliefTwin":
        left = self.base.without(*keys)
        names = list(self.base.parameters)
        return self._over(left, self.draws[:, [names.index(n) for n in left.parameters]])

    def at_interval(self, dt: float, substeps: int) -> "BeliefTwin":
        return self._over(self.base.at_interval(dt, substeps), self.draws)

    def typical_forces(self) -> tuple[float, ...]:
        return self.base.typical_forces()

    def initial(self, key: PRNGKeyArray, params: Params) -> State:
        key, own = jax.random.split(key)
        draw = jax.random.randint(own, (), 0, len(params[_DRAWS]))
        return self._under(draw, self.base.initial(key, self._params(draw, params)))

    def infer(self, obs: Obs, params: Params) -> State:
        draw = jnp.zeros((), int)
        return self._under(draw, self.base.infer(obs, self._params(draw, params)))

    def observe(self, state: State, params: Params) -> Obs:
        return self.base.observe(self.inner_state(state), self.inner_params(state, params))

    def step(
        self, state: State, action: Action, params: Params, effects: EffectChain = NO_EFFECTS
    ) -> State:
        own = self.inner_params(state, params)
        after = self.base.step(self.inner_state(state), action, own, effects)
        return after._replace(memory=after.memory | {_DRAW: state.memory[_DRAW]})

    def to_spec(self) -> dict[str, Any]:
        told = {
            "parameters": list(self.base.parameters),
            "draws": self.draws.tolist(),
            "origin": self.origin.tolist(),
            "answers": list(self.answers),
            "weights": list(self.weights),
        }
        return self.base.with_parameters(**self.values).to_spec() | {"belief": told}

    def structure(self) -> tuple[Any, ...]:
        return (type(self), self.base, self.varied)

    def __repr__(self) -> str:
        return f"BeliefTwin({self.base!r}, {self.n_draws} draws)"

    def _over(self, base: Twin, draws: np.ndarray) -> "BeliefTwin":
        return BeliefTwin(base, draws, self.origin, self.answers, self.weights)

    def _params(self, draw: Any, params: Params) -> Params:
        own = params[_DRAWS][draw]
        drawn = {name: own[i] for i, name in enumerate(self.varied)}
        return {name: params[name] for name in (*self.values, *self.base.tensors)} | drawn

    def inner_state(self, state: State) -> State:
        memory = {key: own for key, own in state.memory.items() if key != _DRAW}
        return state._replace(memory=memory)

    def inner_params(self, state: State, params: Params) -> Params:
        draw = jax.lax.stop_gradient(state.memory[_DRAW])
        return self._params(jnp.round(draw).astype(int), params)

    def _under(self, draw: Any, state: State) -> State:
        return state._replace(memory=state.memory | {_DRAW: draw.astype(state.q.dtype)})


def belief_over(base: Twin, told: Mapping[str, Any]) -> BeliefTwin:
    """
    :param told: what ``to_spec`` wrote as ``"belief"``
    :raises ParameterError: for other parameters than the twin's, or impossible draws
    """
    names = list(base.parameters)
    if sorted(told["parameters"]) != sorted(names):
        raise ParameterError(
            f"The belief is about {', '.join(told['parameters'])}, and {base.name} has "
            f"{', '.join(names)}: it belongs to another twin."
        )
    order = [list(told["parameters"]).index(name) for name in names]
    draws = np.asarray(told["draws"], float)
    return BeliefTwin(
        base, draws[:, order], np.asarray(told["origin"]), told["answers"], told["weights"]
    )


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
            f"origin must be the number of one of {len(answers)} answers for each of "
            f"{len(draws)} draws, got shape {origin.shape}."
        )
    for name, column in zip(names, draws.T, strict=True):
        for value in (column.min(), column.max()):
            base.parameters[name].check(name, value)
