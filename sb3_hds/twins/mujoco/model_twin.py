"""What twins of MuJoCo's models share: quaternions in positions, signals, and tasks."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float, PRNGKeyArray

from sb3_hds.core import State, Twin
from sb3_hds.core.types import (
    Action,
    Coordinates,
    Flag,
    Memory,
    Obs,
    Params,
    Position,
    Scalar,
    Tangent,
    Velocity,
)
from sb3_hds.errors import ParameterError
from sb3_hds.twins.mujoco.rigid_body.quaternions import normalized, turn_between, turned

#: reward(state, action, next_state, params), and terminated(state, params)
Reward = Callable[[State, Action, State, Params], Scalar]
Terminated = Callable[[State, Params], Flag]


class QuaternionTwin(Twin):
    """
    Abstract: a twin whose positions may contain quaternions. In tangents and coordinates, their
    places have rotation vectors [rad], and the velocity of a ball or free joint is MuJoCo's: its
    rotation in the body's frame.
    """

    @property
    @abc.abstractmethod
    def quaternions(self) -> tuple[tuple[int, int], ...]:
        """Index of each quaternion in positions, and how much lower it is in velocities."""

    @property
    @abc.abstractmethod
    def reference(self) -> Float[np.ndarray, " n_q"]:
        """The position at which all coordinates are zero."""

    def coordinates(self, q: Position) -> Coordinates:
        """Quaternions become rotation vectors from the reference position."""
        return self._between(q, jnp.asarray(self.reference, q.dtype)) if self.quaternions else q

    def displace(self, q: Position, displacement: Velocity) -> Position:
        """:return: the position moved by a velocity times a time"""
        if not self.quaternions:
            return q + displacement
        parts, at = [], 0
        for start, shift in self.quaternions:
            parts.append(q[at:start] + displacement[at - shift : start - shift])
            turn = displacement[start - shift : start - shift + 3]
            parts.append(turned(q[start : start + 4], turn))
            at = start + 4
        return jnp.concatenate([*parts, q[at:] + displacement[at - len(self.quaternions) :]])

    def difference(self, state: State, reference: State) -> Tangent:
        memory = ravel_pytree(self.kept(state))[0] - ravel_pytree(self.kept(reference))[0]
        moved = self._between(state.q, reference.q)
        return jnp.concatenate([moved, state.v - reference.v, memory.astype(moved.dtype)])

    def retract(self, state: State, tangent: Tangent) -> State:
        n = len(state.v)
        memory, unravel = ravel_pytree(self.kept(state))
        moved = unravel(memory + tangent[2 * n :].astype(memory.dtype))
        q = self.displace(state.q, tangent[:n])
        return State(q, state.v + tangent[n : 2 * n], state.memory | moved)

    def kept(self, state: State) -> dict[str, Memory]:
        """:return: the part of the memory that belongs to the tangent space"""
        return state.memory

    def _between(self, q: Position, reference: Position) -> Coordinates:
        parts, at = [], 0
        for start, _ in self.quaternions:
            parts.append(q[at:start] - reference[at:start])
            parts.append(turn_between(q[start : start + 4], reference[start : start + 4]))
            at = start + 4
        return jnp.concatenate([*parts, q[at:] - reference[at:]])


class ModelTwin(QuaternionTwin):
    """Abstract: the twin of any model, which observes its state and may have a task."""

    #: largest distance of initial positions from :attr:`start` [rad] or [m]
    near_start: ClassVar[float]

    @property
    @abc.abstractmethod
    def start(self) -> Float[np.ndarray, " n_q"]:
        """The model's first keyframe, or its reference position."""

    def set_task(self, observe: str, reward: Reward | None, terminated: Terminated | None) -> None:
        """
        :param observe: ``"qv"`` for positions and velocities, ``"q"`` for positions only
        :param reward: None: zero
        :param terminated: None: never
        :raises ParameterError: for another ``observe``
        """
        if observe not in ("q", "qv"):
            raise ParameterError(f"{self.name} can observe 'q' or 'qv', got {observe!r}.")
        self.observed, self._reward, self._terminated = observe, reward, terminated

    def initial(self, key: PRNGKeyArray, params: Params) -> State:
        """At rest, near the model's first keyframe or its reference position."""
        start, n, near = jnp.array(self.start), len(self.joints), self.near_start
        offset = jax.random.uniform(key, (n,), minval=-near, maxval=near)
        return State(self.displace(start, offset.astype(start.dtype)), jnp.zeros(n), {})

    def infer(self, obs: Obs, params: Params) -> State:
        n, dof = len(self.reference), len(self.joints)
        q = obs[:n]
        for at, _ in self.quaternions:
            q = q.at[at : at + 4].set(normalized(q[at : at + 4]))
        return State(q, obs[n:] if self.observed == "qv" else jnp.zeros(dof, obs.dtype), {})

    def observe(self, state: State, params: Params) -> Obs:
        return jnp.concatenate([state.q, state.v]) if self.observed == "qv" else state.q

    def reward(self, state: State, action: Action, next_state: State, params: Params) -> Scalar:
        if self._reward is None:
            return super().reward(state, action, next_state, params)
        return self._reward(state, action, next_state, params)

    def terminated(self, state: State, params: Params) -> Flag:
        if self._terminated is None:
            return super().terminated(state, params)
        return self._terminated(state, params)

    def structure(self) -> tuple[Any, ...]:
        return (*super().structure(), self.observed, self._reward, self._terminated)
