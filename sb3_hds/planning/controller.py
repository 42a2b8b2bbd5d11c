"""Model-predictive control as a policy, with Stable-Baselines3's ``predict``."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sb3_hds.core import Params, State, Twin
from sb3_hds.core.contract import check_methods
from sb3_hds.core.numerics.compilation import QUICK_COMPILATION
from sb3_hds.errors import ParameterError
from sb3_hds.planning.problem import Controls, Plan, Problem, simulate
from sb3_hds.planning.solve import METHODS, random_controls

# Time to look ahead where no horizon is given [s], within these numbers of steps.
_LOOKAHEAD, _SHORTEST, _LONGEST = 1.0, 20, 60
_STEP_SIZES = 6


class MPC:
    """
    A policy that plans in a twin, from :func:`mpc`.

    It has a plan for each copy of the environment, so one object serves one loop at a time. A new
    episode has to be announced by ``episode_start``, as SB3's ``evaluate_policy`` does.

    :param twin: to plan in
    :param horizon: steps of a plan
    :param replan_every: steps of a plan that are executed
    :param settings: of the planner: method, number of iterations, discount, number of random plans
    :param seed: of the random plans at the start of an episode
    """

    def __init__(
        self,
        twin: Twin,
        horizon: int,
        replan_every: int,
        settings: tuple[str, int, float, int],
        seed: int,
    ) -> None:
        self.twin, self.horizon, self.replan_every = twin, horizon, replan_every
        self._settings = settings
        self._key = jax.random.key(seed)
        self._plans: np.ndarray | None = None  # (n_envs, horizon, n_act), from the next step on
        self._left = 0
        #: plans made so far, over all copies
        self.n_plans = 0

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """
        :param observation: of one environment, ``(n_obs,)``, or of several, ``(n_envs, n_obs)``
        :param state: passed on; the plans are in this object
        :param episode_start: whether an episode begins in each environment, ``(n_envs,)``
        :param deterministic: has no effect: plans are deterministic but for their first start
        :return: actions, ``(n_act,)`` or ``(n_envs, n_act)``, and ``state``
        :raises ValueError: for observations of another shape
        """
        obs = np.asarray(observation)
        if obs.ndim not in (1, 2) or obs.shape[-1] != len(self.twin.channels):
            raise ValueError(
                f"{self.twin.name} observes {len(self.twin.channels)} channels, got an observation "
                f"of shape {obs.shape}."
            )
        rows = obs.reshape(-1, obs.shape[-1])
        begun = np.zeros(len(rows), bool)
        begun |= False if episode_start is None else np.asarray(episode_start, bool).reshape(-1)
        if self._plans is None or len(self._plans) != len(rows):
            self._plans = np.zeros((len(rows), self.horizon, len(self.twin.actuators)))
            begun[:] = True
        if begun.any() or self._left == 0:
            self._replan(rows, begun)
        control, self._left = self._plans[:, 0], self._left - 1
        repeated = self._plans[:, -1:]
        self._plans = np.concatenate([self._plans[:, 1:], repeated], 1)
        low, high = np.array([(a.low, a.high) for a in self.twin.actuators]).T
        action = (low + 0.5 * (control + 1.0) * (high - low)).astype(np.float32)
        return action.reshape(*obs.shape[:-1], -1), state

    def _replan(self, rows: np.ndarray, begun: np.ndarray) -> None:
        assert self._plans is not None
        self._key, key = jax.random.split(self._key)
        with jax.enable_x64(True):
            given = (rows.astype(np.float64), self._plans, begun, key, self.twin.params)
            plans = _improved(self.twin, self._settings, *given)
            self._plans = np.array(plans.controls)
        self._left = self.replan_every
        self.n_plans += len(rows)


def mpc(
    twin: Twin,
    *,
    horizon: int | None = None,
    replan_every: int = 1,
    n_iterations: int = 3,
    n_random_plans: int = 32,
    method: str = "ilqr",
    discount: float = 1.0,
    seed: int = 0,
) -> MPC:
    """
    Model-predictive control of a twin's environment: a policy that improves a plan from each
    observation, executes its first steps, and shifts it. It learns nothing.

    Planning is in double precision. The start state is the one that ``twin.infer`` returns, so what
    is not observed counts as zero.

    :param twin: of the environment
    :param horizon: steps of a plan; default: one second, between 20 and 60 steps
    :param replan_every: steps of a plan that are executed
    :param n_iterations: improvements of each plan
    :param n_random_plans: random control sequences at the start of an episode, of which the best is
        the first plan
    :param method: ``"ilqr"``, ``"gauss_newton"`` or ``"first_order"``
    :param discount: per step, in (0, 1]
    :param seed: of the random plans
    :return: a policy with ``predict``, as SB3's ``evaluate_policy`` takes it
    :raises ParameterError: for an argument out of its range
    :raises TwinError: for a twin whose methods return a wrong shape or dtype
    """
    check_methods(twin)
    if horizon is None:
        horizon = int(np.clip(round(_LOOKAHEAD / twin.dt), _SHORTEST, _LONGEST))
    counts = {"horizon": horizon, "n_iterations": n_iterations, "n_random_plans": n_random_plans}
    for name, count in counts.items():
        if not (isinstance(count, int) and count >= 1):
            raise ParameterError(f"{name} must be a whole number of at least 1, got {count!r}.")
    if not (isinstance(replan_every, int) and 1 <= replan_every <= horizon):
        raise ParameterError(
            f"replan_every must lie between 1 and the horizon, {horizon}, got {replan_every!r}."
        )
    if method not in METHODS:
        raise ParameterError(f"method must be one of {', '.join(METHODS)}, got {method!r}.")
    if not 0.0 < discount <= 1.0:
        raise ParameterError(f"discount must be above 0 and at most 1, got {discount!r}.")
    unbounded = [a.name for a in twin.actuators if not np.isfinite([a.low, a.high]).all()]
    if unbounded:
        raise ParameterError(
            f"Plans keep commands within their limits, and {', '.join(unbounded)} of {twin.name} "
            "has none. Give the actuators a ctrlrange."
        )
    return MPC(twin, horizon, replan_every, (method, n_iterations, discount, n_random_plans), seed)


@partial(jax.jit, static_argnums=(0, 1), compiler_options=QUICK_COMPILATION)
def _improved(
    twin: Twin,
    settings: tuple[str, int, float, int],
    obs: Float[Array, "n obs"],
    plans: Float[Array, "n horizon act"],
    begun: Any,
    key: Any,
    params: Params,
) -> Plan:
    method, n_iterations, discount, n_random = settings
    problem = Problem(twin, params, discount)
    horizon, n_act = plans.shape[1:]

    def first(start: State, warm: Controls, key: Any) -> Plan:
        """The best of the shifted plan and random ones."""
        keys = jax.random.split(key, n_random)
        drawn = jax.vmap(lambda k: random_controls(k, horizon, n_act))(keys)
        candidates = jnp.concatenate([warm[None], drawn])
        found = jax.vmap(lambda u: simulate(problem, start, u))(candidates)
        return jax.tree.map(lambda leaf: leaf[jnp.argmax(found.value)], found)

    starts = jax.vmap(lambda o: twin.infer(o, params))(obs)
    keys = jax.random.split(key, len(obs))
    warm = jax.lax.cond(
        jnp.any(begun),
        lambda: jax.vmap(first)(starts, jnp.where(begun[:, None, None], 0.0, plans), keys),
        lambda: jax.vmap(lambda s, u: simulate(problem, s, u))(starts, plans),
    )
    improve = partial(METHODS[method], n_iterations=n_iterations, n_step_sizes=_STEP_SIZES)
    return jax.vmap(lambda s, plan: improve(problem, s, plan))(starts, warm)
