r"""
How well commands discriminate between answers, as a differentiable program.

Let answer :math:`a` be true. In windows that are simulated from start states of their own, the
residual of answer :math:`b` is at least

.. math::
   \lambda_{ab} = \min_{z, x_0} \frac{1}{c} \sum_k
   \left\| \frac{y_a - y_b(\theta_b + L_b z, x_0)}{\sigma} \right\|^2 + \|z\|^2,

linearised in the start states :math:`x_0` and in :math:`z`: the parameters of :math:`b` are
refitted within what the earlier data allow (:math:`L_b L_b^T` is their covariance). Half of it is
the expected log-likelihood ratio of all data; :math:`c` is the number of rows for each independent
one.

Source: T-optimality, Atkinson and Fedorov, *The design of experiments for discriminating between
two rival models*, Biometrika 62(1), 1975, with the prior of Ponce de Leon and Atkinson, Biometrika
78(3), 1991. Where there is only one answer: the information gain
:math:`\frac{1}{2} \log\det(I + L^T F L)` (Bayesian D-optimality).
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sb3_hds.core import (
    AnalyticTwin,
    EffectChain,
    ExtendedTwin,
    Params,
    SensorEffect,
    State,
    TransformedTwin,
    Twin,
    rollout,
)
from sb3_hds.core.twin import layers_of, plant_of
from sb3_hds.sysid.belief.answers import effect_key, effects_of
from sb3_hds.sysid.design.limits import Bounds
from sb3_hds.sysid.estimation.shooting import eliminate_start, moved_by, with_slopes

# Most frequencies in the commands, and the share of a recording in which they fade in and out.
_MOST_SINES, _FADE = 24, 0.04
# Added to the ratio whose logarithm is maximised: smaller ones are negligible. Weight of the
# information about parameters beside it, so that commands move the machine even where nothing
# discriminates.
_LEAST, _BESIDE = 1.0, 0.1
# Penalty of exceeding a limit, in units of the limit, and the share of it from which it counts.
_PRICE, _NEAR = 200.0, 0.85


class DesignProblem(NamedTuple):
    """
    The numbers of a design problem: traced, so that one compiled program serves all of them.

    :param values: parameters of each answer, shape ``(m, p)``
    :param factor: of their covariances, shape ``(m, p, k)``
    :param corners: parameters for which limits hold, besides those of the answers, ``(c, p)``
    :param start: observation at the start, shape ``(n_obs,)``
    :param weight: reciprocal of the errors of each output, the channels first and then the forces
        of the actuators at each joint; 0 if it is not measured; shape ``(n_obs + dof,)``
    :param correlated: rows for each independent one
    """

    values: np.ndarray
    factor: np.ndarray
    corners: np.ndarray
    start: np.ndarray
    weight: np.ndarray
    correlated: float


class Evaluation(NamedTuple):
    r"""
    Discrimination and usage of limits by commands for ``n`` recordings.

    :param ratios: :math:`\lambda_{ab}`, shape ``(m, m)``
    :param gains: information about the parameters of each answer [nats], shape ``(m,)``
    :param curvature: information matrix of the first answer, by ``z``, shape ``(k, k)``
    :param outputs: channels, then forces, as each answer predicts them, shape
        ``(m, n, steps + 1, n_obs + dof)``
    :param usage: of each limit the largest share that any answer takes, by joint: position,
        velocity, torque, power, jerk; shape ``(5, dof)``
    """

    ratios: Array
    gains: Array
    curvature: Array
    outputs: Array
    usage: Array


class Excitation:
    """
    Commands as sums of sines, and what they would decide.

    :param twin: has the effects of all answers
    :param bounds: limits of the machine
    :param n_steps: of a recording
    :param window: steps of the windows in which answers will be compared
    """

    def __init__(self, twin: Twin, bounds: Bounds, n_steps: int, window: int) -> None:
        self.twin, self.bounds, self.n_steps = twin, bounds, n_steps
        self.window = min(window, n_steps)
        sines = int(np.clip(bounds.bandwidth * n_steps * twin.dt, 1, _MOST_SINES))
        highest = min(bounds.bandwidth * n_steps * twin.dt, n_steps / 2.0)
        cycles = np.linspace(1.0, max(highest, 1.0), sines)
        phase = 2.0 * np.pi * np.outer(np.arange(n_steps) / n_steps, cycles)
        ends = np.minimum(np.arange(n_steps), np.arange(n_steps)[::-1])
        fade = np.clip(ends / max(_FADE * n_steps, 1.0), 0.0, 1.0)[:, None]
        waves = fade * np.concatenate([np.sin(phase), np.cos(phase)], 1)
        self.basis = np.concatenate([np.ones((n_steps, 1)), waves], 1)
        self.cycles = np.concatenate([[0.0], cycles, cycles])
        self.sensors = {effect_key(e) for e in effects_of(twin) if isinstance(e, SensorEffect)}
        self._names = tuple(twin.parameters)
        #: (commands, problem) -> :class:`Evaluation`
        self.evaluate = jax.jit(self._evaluate)
        #: (coefficients of each start, problem) -> objective, largest usage of a limit, gradient
        self.ascent = jax.jit(self._ascent)

    def commands(
        self, coefficients: Float[Array, "n waves act"] | np.ndarray
    ) -> Float[Array, "n steps act"]:
        """:return: smooth commands, within their limits for any coefficients"""
        low, high = self.bounds.command.T
        waves = jnp.einsum("tw,nwa->nta", self.basis, coefficients)
        return 0.5 * (low + high) + 0.5 * (high - low) * jnp.tanh(waves)

    def _ascent(
        self, coefficients: Float[Array, "starts n waves act"], problem: DesignProblem
    ) -> tuple[Array, Array, Array]:

        def cost(one: Array) -> tuple[Array, tuple[Array, Array]]:
            evaluation = self._evaluate(self.commands(one), problem)
            m, usage = len(problem.values), evaluation.usage
            if m == 1:
                objective = evaluation.gains[0]
            else:
                pairs = evaluation.ratios[~np.eye(m, dtype=bool)]
                objective = -jnp.log(jnp.mean(1.0 / (pairs + _LEAST)))
                objective += _BESIDE * jnp.mean(evaluation.gains)
            finite = jnp.where(jnp.isfinite(usage), usage, 1e3)
            over = jnp.maximum(finite - _NEAR, 0.0)
            return -objective + _PRICE * jnp.sum(over**2), (objective, jnp.max(finite))

        if self.twin.differentiability != "forward":
            (_, found), slopes = jax.vmap(jax.value_and_grad(cost, has_aux=True))(coefficients)
        else:
            slopes, found = jax.vmap(jax.jacfwd(cost, has_aux=True))(coefficients)
        return found[0], found[1], slopes

    def _evaluate(self, actions: Float[Array, "n steps act"], problem: DesignProblem) -> Evaluation:
        states, outputs, usage = self._rollouts(actions, problem)
        m = len(problem.values)

        def of(pair: Array) -> tuple[Array, Array, Array]:
            """Residual of answer ``b`` if ``a`` is true, and information about ``b``."""
            a, b = pair
            mine, theirs = (jax.tree.map(lambda leaf, i=i: leaf[i], states) for i in (a, b))
            own = (jnp.asarray(problem.values[b]), jnp.asarray(problem.factor[b]))
            normal = partial(self._normal, *own, jnp.asarray(problem.weight))
            found = jax.vmap(normal)(mine, theirs, outputs[a], actions)
            rest, score, curvature = (jnp.sum(x, 0) / problem.correlated for x in found)
            bread = curvature + jnp.eye(len(curvature), dtype=curvature.dtype)
            moved = jnp.linalg.solve(bread, score)
            return rest - score @ moved, 0.5 * jnp.linalg.slogdet(bread)[1], curvature

        pairs = np.stack(np.meshgrid(range(m), range(m), indexing="ij"), -1).reshape(-1, 2)
        ratios, gains, curvature = jax.vmap(of)(jnp.asarray(pairs))
        own = jnp.diag(gains.reshape(m, m))
        return Evaluation(ratios.reshape(m, m), own, curvature[0], outputs[:m], usage)

    def _rollouts(self, actions: Array, problem: DesignProblem) -> tuple[State, Array, Array]:
        """Simulate the answers, then the corners; only the answers' states are returned."""
        vectors = jnp.concatenate([problem.values, problem.corners])

        def one(vector: Array, commands: Array) -> tuple[State, Array, Array]:
            params = self._params(vector)
            begin = self.twin.infer(jnp.asarray(problem.start), params)
            begin = jax.tree.map(lambda leaf: jnp.asarray(leaf, vector.dtype), begin)
            run = rollout(self.twin, params, begin, commands)
            force = self._forces(run.states, commands, params)
            # Without the effects on commands too: a delayed command may act after the recording.
            plain = self._forces(run.states, commands, params, with_effects=False)
            most = jnp.maximum(jnp.abs(force), jnp.abs(plain))
            outputs = jnp.concatenate([run.obs, force], 1)
            return run.states, outputs, self._usage(run.states, most)

        states, outputs, usage = jax.vmap(lambda v: jax.vmap(lambda a: one(v, a))(actions))(vectors)
        states = jax.tree.map(lambda leaf: leaf[: len(problem.values)], states)
        return states, outputs, jnp.max(usage, (0, 1))

    def _forces(
        self, states: State, commands: Array, params: Params, with_effects: bool = True
    ) -> Array:
        """
        Forces of the actuators at each joint, shape ``(steps + 1, dof)``; zeros where unknown.

        :param with_effects: whether effects on the commands, such as a gain or a delay, count
        """
        if not isinstance(plant_of(self.twin), AnalyticTwin):
            return jnp.zeros((len(commands) + 1, len(self.twin.joints)), commands.dtype)
        before = jax.tree.map(lambda leaf: leaf[:-1], states)
        force = jax.vmap(lambda s, u: actuator_force(self.twin, s, u, params, with_effects))(
            before, commands
        )
        return jnp.concatenate([force, force[-1:]])

    def _usage(self, states: State, force: Array) -> Array:
        """Largest share of each limit over time, shape ``(5, dof)``."""
        b, dt = self.bounds, self.twin.dt
        q, v = jax.vmap(self.twin.coordinates)(states.q), states.v
        low, high = b.position.T
        half = np.where(np.isfinite(high - low), 0.5 * (high - low), 1.0)
        position = jnp.maximum(jnp.maximum(1.0 + (q - high) / half, 1.0 + (low - q) / half), 0.0)
        jerk = (v[2:] - 2.0 * v[1:-1] + v[:-2]) / dt**2
        return jnp.stack(
            [
                jnp.max(position, 0),
                jnp.max(jnp.abs(v), 0) / b.velocity,
                jnp.max(jnp.abs(force), 0) / b.torque,
                jnp.max(jnp.abs(force * v), 0) / b.power,
                jnp.max(jnp.abs(jerk), 0) / b.jerk,
            ]
        )

    def _normal(
        self,
        values: Array,
        factor: Array,
        weight: Array,
        mine: State,
        theirs: State,
        seen: Array,
        commands: Array,
    ) -> tuple[Array, Array, Array]:
        """
        One recording under answer ``b``, in windows that begin in the states of answer ``a``.

        :param mine: states of ``a``
        :param theirs: states of ``b``, for the memory of its drives
        :param seen: outputs of ``a``
        :return: sum of squares, scores and curvature by ``z``, start states eliminated
        """
        length, n = self.window, self.n_steps // self.window
        firsts = length * np.arange(n)
        memory = {k: (mine if k in self.sensors else theirs).memory[k] for k in mine.memory}
        begins = jax.tree.map(lambda leaf: leaf[firsts], State(mine.q, mine.v, memory))
        rows = firsts[:, None] + np.arange(length)
        outputs = seen[firsts[:, None] + np.arange(length + 1)]
        n_z, n_x = factor.shape[1], 2 * len(self.twin.joints)

        def window(begin: State, actions: Array, outputs: Array) -> tuple[Array, Array, Array]:
            def error(both: Array) -> Array:
                params = self._params(values + factor @ both[:n_z])
                there = moved_by(self.twin, begin, both[n_z:])
                there = jax.tree.map(lambda leaf, was: leaf.astype(was.dtype), there, begin)
                run = rollout(self.twin, params, there, actions)
                force = self._forces(run.states, actions, params)
                predicted = jnp.concatenate([run.obs, force], 1)
                return ((predicted - outputs)[:-1] * weight).ravel()

            errors, slopes = with_slopes(error, jnp.zeros(n_z + n_x, begin.q.dtype))
            own, along, _ = eliminate_start(errors, slopes, n_z)
            return own @ own, along.T @ own, along.T @ along

        found = jax.vmap(window)(begins, commands[rows], outputs)
        rest, score, curvature = (jnp.sum(x, 0) for x in found)
        return rest, score, curvature

    def _params(self, vector: Array) -> Params:
        return {name: vector[i] for i, name in enumerate(self._names)} | dict(self.twin.tensors)


def actuator_force(
    twin: Twin, state: State, action: Array, params: Params, with_effects: bool = True
) -> Float[Array, " dof"]:
    """
    :param twin: of an ``AnalyticTwin``, with effects and wrappers or without
    :param action: as the outermost twin takes it, shape ``(n_act,)``
    :param with_effects: whether effects on the command count, such as a gain or a delay
    :return: generalised force of the actuators at the beginning of a step [N m] or [N]
    """
    command = action
    for layer in layers_of(twin):
        if isinstance(layer, TransformedTwin):
            command = layer.command(state, command, params)
        elif isinstance(layer, ExtendedTwin):
            if with_effects:
                simulated = tuple(a for a in layer.attached if a.key in state.memory)
                chain = EffectChain(simulated, params)
                command, _ = chain.act(command, state.memory, twin.dt / twin.substeps)
            params = layer.base_params(params)
    plant = plant_of(twin)
    assert isinstance(plant, AnalyticTwin)
    return plant.actuate(state, command, params)
