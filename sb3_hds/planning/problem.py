"""The planning problem, and the plan that solves it."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sb3_hds.core import Action, Flag, Obs, Params, Scalar, State, Twin

Control: TypeAlias = Float[Array, " act"]  # an action scaled to [-1, 1]
Controls: TypeAlias = Float[Array, "horizon act"]
TerminalValue: TypeAlias = Callable[[Obs], Scalar]


class Plan(NamedTuple):
    """
    A sequence of controls with its states and rewards.

    :param controls: scaled actions in [-1, 1], shape ``(horizon, n_act)``
    :param states: leaves of shape ``(horizon + 1, ...)``, the start state first
    :param rewards: scaled planning rewards, zero after termination, shape ``(horizon,)``
    :param alive: whether the episode still runs at each state, shape ``(horizon + 1,)``
    :param value: the objective, minus infinity where it is not finite
    """

    controls: Controls
    states: State
    rewards: Float[Array, " horizon"]
    alive: Bool[Array, " horizon_1"]
    value: Scalar


@dataclasses.dataclass(frozen=True)
class Problem:
    r"""
    Maximise, over controls :math:`u_t \in [-1, 1]`,

    .. math:: \sum_{t<H} \gamma^t\, s\,(r_t - r_0) + \gamma^H V(o_H)

    where :math:`r` is the twin's planning reward. A terminated episode has the value
    :math:`-s\,r_0/(1-\gamma)` from there on, so that shifting every reward by :math:`r_0` changes
    the objective by a constant only and does not reward termination. There is no auto-reset.
    Without ``shift_ends`` a termination has the value zero, more than any reward below :math:`r_0`.

    :param twin: the simulation
    :param params: parameters of the twin
    :param discount: :math:`\gamma` per step, in (0, 1]
    :param reward_scale: :math:`s`
    :param reward_offset: :math:`r_0`; must be zero where the discount is one
    :param terminal_value: :math:`V`, scaled like the rewards; None means zero
    :param terminal_curvature: whether second-order methods use the Hessian of :math:`V` too
    :param terminal_roots: observation to :math:`\rho`, shape ``(k,)``, with :math:`V \approx c -
        |\rho|^2`. Their Gauss-Newton curvature replaces the Hessian of :math:`V`: it is never
        positive, and as smooth as a gradient.
    :param shift_ends: whether the value after termination is shifted with the rewards
    """

    twin: Twin
    params: Params
    discount: float = 1.0
    reward_scale: float | Scalar = 1.0
    reward_offset: float | Scalar = 0.0
    terminal_value: TerminalValue | None = None
    terminal_curvature: bool = False
    terminal_roots: Callable[[Obs], Float[Array, " k"]] | None = None
    shift_ends: bool = True

    @property
    def n_controls(self) -> int:
        return len(self.twin.actuators)

    def with_params(self, params: Params) -> "Problem":
        """:return: the same problem with other values for these parameters"""
        return dataclasses.replace(self, params=self.params | params) if params else self

    def action(self, control: Control) -> Action:
        """:return: the action, in units of the action space, for a control in [-1, 1]"""
        low = jnp.array([actuator.low for actuator in self.twin.actuators], control.dtype)
        high = jnp.array([actuator.high for actuator in self.twin.actuators], control.dtype)
        return low + 0.5 * (control + 1.0) * (high - low)

    def advance(self, state: State, control: Control) -> State:
        """:return: the next state"""
        return self.twin.step(state, self.action(control), self.params)

    def reward(self, state: State, control: Control, after: State) -> Scalar:
        """:return: the scaled, shifted planning reward of the step from ``state`` to ``after``"""
        reward = self.twin.planning_reward(state, self.action(control), after, self.params)
        return (reward - self.reward_offset) * self.reward_scale

    def observe(self, state: State) -> Obs:
        return self.twin.observe(state, self.params)

    def terminated(self, state: State) -> Flag:
        return self.twin.terminated(state, self.params)

    @property
    def value_when_terminated(self) -> Scalar:
        """The value of a terminated episode, scaled and shifted."""
        if self.discount == 1.0 or not self.shift_ends:
            return jnp.zeros(())
        return -jnp.asarray(self.reward_offset * self.reward_scale) / (1.0 - self.discount)

    def value_at_end(self, state: State) -> Scalar:
        """:return: the terminal value of a state that is not terminated"""
        if self.terminal_value is None:
            return jnp.zeros(())
        return self.terminal_value(self.observe(state))


def simulate(problem: Problem, start: State, controls: Controls) -> Plan:
    """Roll out a control sequence and score it."""
    return roll_out(problem, start, lambda _, control: control, controls, controls.shape[0])


def as_plan(problem: Problem, start: State, first: Controls | Plan) -> Plan:
    """:return: the plan of the controls from ``start``; a plan is returned unchanged"""
    return first if isinstance(first, Plan) else simulate(problem, start, first)


def follow(problem: Problem, start: State, policy: Callable[[Obs], Control], n_steps: int) -> Plan:
    """
    Roll out a policy and score it.

    :param policy: maps an observation of the twin to a control; clipped to [-1, 1]
    :param n_steps: length of the plan
    """

    def decide(state: State, _: None) -> Control:
        return jnp.clip(policy(problem.observe(state)), -1.0, 1.0)

    return roll_out(problem, start, decide, None, n_steps)


def roll_out(problem: Problem, start: State, decide: Callable, inputs: Any, length: int) -> Plan:
    """
    :param decide: maps a state and its slice of ``inputs`` to a control in [-1, 1]
    :param inputs: pytree whose leaves have a leading axis of ``length``; None: no inputs
    :return: the simulated and scored plan of these decisions
    """

    def advance(carry: tuple[State, Flag], given: Any):
        state, alive = carry
        control = decide(state, given)
        after = problem.advance(state, control)
        reward = problem.reward(state, control, after)
        still = alive & ~problem.terminated(after)
        return (after, still), (state, alive, jnp.where(alive, reward, 0.0), control)

    first = (start, ~problem.terminated(start))
    (end, alive), taken = jax.lax.scan(advance, first, inputs, length=length)
    return assemble(problem, end, alive, *taken)


def assemble(
    problem: Problem,
    end: State,
    alive_at_end: Flag,
    states: State,
    alive: Bool[Array, " horizon"],
    rewards: Float[Array, " horizon"],
    controls: Controls,
) -> Plan:
    """:return: the scored plan that consists of these steps and the final state"""
    states = jax.tree.map(lambda path, last: jnp.concatenate([path, last[None]]), states, end)
    lived = jnp.append(alive, alive_at_end)
    value = score(problem, rewards, lived, problem.value_at_end(end))
    return Plan(controls, states, rewards, lived, value)


def score(
    problem: Problem,
    rewards: Float[Array, " horizon"],
    alive: Bool[Array, " horizon_1"],
    value_at_end: Scalar,
) -> Scalar:
    """:return: the objective of a trajectory; minus infinity where it is not finite"""
    horizon = rewards.shape[0]
    discounts = problem.discount ** jnp.arange(horizon + 1, dtype=rewards.dtype)
    ended = alive[:-1] & ~alive[1:]
    after_death = jnp.sum(jnp.where(ended, discounts[1:], 0.0)) * problem.value_when_terminated
    tail = jnp.where(alive[-1], discounts[-1] * value_at_end, 0.0)
    total = jnp.sum(discounts[:-1] * rewards) + tail + after_death
    return jnp.where(jnp.isfinite(total), total, -jnp.inf)
