"""Model-predictive control as a policy, with Stable-Baselines3's ``predict``."""

from functools import partial
from typing import Any, NamedTuple

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


class Settings(NamedTuple):
    """
    :param method: of improvement
    :param n_iterations: improvements of each plan
    :param discount: per step
    :param n_random_plans: at the start of an episode
    """

    method: str
    n_iterations: int
    discount: float
    n_random_plans: int


class MPC:
    """
    A policy that plans in a twin, from :func:`mpc`.

    It has a plan for each copy of the environment, so one object serves one loop at a time. A new
    episode has to be announced by ``episode_start``, as SB3's ``evaluate_policy`` does.

    :param twin: to plan in
    :param horizon: steps of a plan
    :param replan_every: steps of a plan that are executed
    :param settings: of the planner
    :param seed: of the random plans at the start of an episode
    """

    def __init__(
        self,
        twin: Twin,
        horizon: int,
        replan_every: int,
        settings: "Settings",
        seed: int,
    ) -> None:
        self.twin, self.horizon, self.replan_every = twin, horizon, replan_every
        self._settings = settings
        self._key = jax.random.key(seed)
        # Controls and actions of the last plans, (n_envs, horizon, n_act), and their next step.
        self._controls: np.ndarray | None = None
        self._actions, self._at = np.empty(0), 0
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
        if self._controls is None or len(self._controls) != len(rows):
            self._controls = np.zeros((len(rows), self.horizon, len(self.twin.actuators)))
            begun[:] = True
        if begun.any() or self._at == self.replan_every:
            self._replan(rows, begun)
        action, self._at = self._actions[:, self._at], self._at + 1
        return action.reshape(*obs.shape[:-1], -1), state

    def _replan(self, rows: np.ndarray, begun: np.ndarray) -> None:
        assert self._controls is not None
        later = np.minimum(np.arange(self.horizon) + self._at, self.horizon - 1)
        self._key, key = jax.random.split(self._key)
        with jax.enable_x64(True):
            given = (rows.astype(np.float64), self._controls[:, later], begun, key)
            controls, actions = _improved(self.twin, self._settings, *given, self.twin.params)
        self._controls, self._actions = np.asarray(controls), np.asarray(actions, np.float32)
        self._at = 0
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
    return MPC(
        twin, horizon, replan_every, Settings(method, n_iterations, discount, n_random_plans), seed
    )


@partial(jax.jit, static_argnums=(0, 1), compiler_options=QUICK_COMPILATION)
def _improved(
    twin: Twin,
    settings: Settings,
    obs: Float[Array, "n obs"],
    plans: Float[Array, "n horizon act"],
    begun: Any,
    key: Any,
    params: Params,
) -> tuple[Float[Array, "n horizon act"], Float[Array, "n horizon act"]]:
    """:return: controls and actions of the plans"""
    problem = Problem(twin, params, settings.discount)
    horizon, n_act = plans.shape[1:]

    def first(start: State, warm: Controls, key: Any) -> Plan:
        """The best of the shifted plan and random ones."""
        keys = jax.random.split(key, settings.n_random_plans)
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
    improve = partial(
        METHODS[settings.method], n_iterations=settings.n_iterations, n_step_sizes=_STEP_SIZES
    )
    controls = jax.vmap(lambda s, plan: improve(problem, s, plan).controls)(starts, warm)
    return controls, jax.vmap(jax.vmap(problem.action))(controls)
