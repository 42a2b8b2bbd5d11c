"""Multiple shooting: fit hypotheses to windows of data, all by one compiled program."""

import dataclasses
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from functools import cached_property, partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sb3_hds.core import Effect, EffectChain, Params, Twin
from sb3_hds.core.effect_chain import Chosen
from sb3_hds.core.numerics.compilation import QUICK_COMPILATION
from sb3_hds.core.numerics.linear import uses_lapack
from sb3_hds.sysid.estimation.hypotheses import Hypotheses
from sb3_hds.sysid.estimation.normal_equations import (
    Blocks,
    damped_step,
    eliminate_starts,
    normal_equations,
)
from sb3_hds.sysid.estimation.shooting import Shots, n_steps_of, simulate, with_slopes
from sb3_hds.sysid.motion.joints import first_offsets

# Threshold of Huber's loss, in units of the noise.
_HUBER = 3.0
# Damping of the first step, relative to the curvature, how it changes, and where it ends.
_DAMPING, _LESS, _MORE, _MOST_DAMPING = 1e-3, 0.2, 8.0, 1e6
# A step that lowers the cost by a smaller share than this is the last.
_ENOUGH = 1e-4
# Steps after which a fit that has to beat another is given up if its cost is this many times
# larger. Of 49 such fits on two machines of two joints, none came closer by more than a factor of
# 3.6 after its third step, and those that did better than the other had 1.2 times its cost by then,
# or less.
_HOPELESS = ((3, 30.0), (8, 5.0))
# Most windows that are simulated at a time, and the number of which theirs is a multiple.
_PORTION, _ROUND = 64, 8
# Steps of all windows, or joints, beyond which a second program, for start states alone, is worth
# compiling: 8 s for one joint with all its effects, as 50 passes over so many steps take.
_MANY_STEPS, _MANY_JOINTS = 60_000, 3
# Held by programs that call LAPACK, which must not run beside one another.
_LAPACK = threading.Lock()
_Given = TypeVar("_Given")
_Told = TypeVar("_Told")


def portion_for(n: int) -> int:
    """:return: windows to simulate at a time where there are ``n`` or fewer"""
    n_portions = -(-n // _PORTION)
    return _ROUND * -(-n // (_ROUND * n_portions))


class Point(NamedTuple):
    """
    Parameters, start states, and the residuals with them.

    :param theta: all parameters that may move, shape ``(p,)``
    :param offsets: of the start states, shape ``(n, free)``
    :param residual: simulated minus measured, shape ``(n, steps + 1, n_obs)``
    :param cost: minus log likelihood with Huber's loss, plus the prior of the fitted parameters
    """

    theta: np.ndarray
    offsets: np.ndarray
    residual: np.ndarray
    cost: float


class Solution(NamedTuple):
    """
    :param point: the end of the search
    :param converged: whether another step would hardly lower the cost
    :param n_steps: that were taken
    """

    point: Point
    converged: bool
    n_steps: int


class Slopes(NamedTuple):
    """
    At a point, start states eliminated, parameters in units of their scale.

    :param curvature: of the cost of each window, shape ``(n, p, p)``
    :param scores: slopes of the cost of each window, shape ``(n, p)``
    """

    curvature: np.ndarray
    scores: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Evidence:
    """
    Windows of data, and the likelihood of hypotheses given them.

    :param hypotheses: hypotheses and parameters
    :param shots: windows, all of weight one
    :param noise: of each channel, shape ``(n_obs,)``
    :param width: most parameters that move at a time
    :param rows: whether a row of a window counts, shape ``(steps + 1,)``; default: all do
    :param portion: windows that are simulated at a time: one program serves data of every size
    :param threshold: of Huber's loss, in units of the noise
    """

    hypotheses: Hypotheses
    shots: Shots
    noise: Float[np.ndarray, " obs"]
    width: int
    rows: Float[np.ndarray, " rows"] | None = None
    portion: int = _PORTION
    threshold: float = _HUBER

    def with_noise(self, noise: Float[np.ndarray, " obs"]) -> "Evidence":
        return dataclasses.replace(self, noise=noise)

    def on(self, shots: Shots, rows: Float[np.ndarray, " rows"] | None = None) -> "Evidence":
        """:return: the same hypotheses on other windows of the same length"""
        return dataclasses.replace(self, shots=shots, rows=rows)

    def fit(
        self,
        theta: Float[np.ndarray, " p"],
        free: Sequence[int],
        offsets: Float[np.ndarray, "n free"] | None = None,
        n_steps: int = 15,
        rival: float = np.inf,
    ) -> Point:
        """:return: where :meth:`solve` ends"""
        return self.solve(theta, free, offsets, n_steps, rival=rival).point

    def solve(
        self,
        theta: Float[np.ndarray, " p"],
        free: Sequence[int],
        offsets: Float[np.ndarray, "n free"] | None = None,
        n_steps: int = 15,
        enough: float = _ENOUGH,
        least: float = 0.0,
        rival: float = np.inf,
    ) -> "Solution":
        """
        Levenberg-Marquardt over the start states and some parameters, within their bounds.

        :param theta: where to begin
        :param free: indices of the parameters that move; none: only start states do
        :param offsets: of the start states, where to begin; default: as measured
        :param n_steps: at most
        :param enough: a step that lowers the cost by a smaller share than this is the last
        :param least: so is one that lowers it by less than this
        :param rival: cost of the fit to beat: one that stays far above it is given up
        """
        h, moving = self.hypotheses, np.array(free, int)
        low, high, size = h.lower[moving], h.upper[moving], h.scale[moving]
        theta = np.array(theta, float)
        offsets = self._measured(theta) if offsets is None else offsets
        now, damping = self._blocks(theta, moving, offsets), _DAMPING
        null, prior_precision = h.null[moving], (size / h.prior[moving]) ** 2

        def prior_cost(x: np.ndarray) -> float:
            return float(0.5 * prior_precision @ ((x[moving] - null) / size) ** 2)

        converged, taken = False, 0
        for _ in range(n_steps):
            taken += 1
            step = eliminate_starts(now, damping)
            new = theta.copy()
            prior_terms = prior_precision, prior_precision * (theta[moving] - null) / size
            new[moving] = damped_step(theta[moving], step, prior_terms, size, low, high, damping)
            z = (new[moving] - theta[moving]) / size
            ahead = offsets + step.from_score + step.from_step @ z
            then = self._blocks(new, moving, ahead)
            if not len(moving):
                # Start states of different windows are independent.
                better = then.cost < now.cost
                gained = np.sum((now.cost - then.cost)[better])
                offsets = np.where(better[:, None], ahead, offsets)
                now = Blocks(
                    *(
                        np.where(better.reshape(-1, *[1] * (a.ndim - 1)), a, b)
                        for a, b in zip(then, now, strict=True)
                    )
                )
            else:
                lower = now.cost.sum() + prior_cost(theta) - then.cost.sum() - prior_cost(new)
                gained = max(lower, 0.0)
                if gained:
                    theta, offsets, now = new, ahead, then
            damping *= _LESS if gained else _MORE
            far = now.cost.sum() / rival
            if any(taken >= steps and far > ratio for steps, ratio in _HOPELESS):
                break
            if (gained and gained < enough * now.cost.sum() + least) or damping > _MOST_DAMPING:
                converged = True
                break
        point = Point(theta, offsets, now.residual, float(now.cost.sum()) + prior_cost(theta))
        return Solution(point, converged, taken)

    def slopes(self, point: Point, index: Sequence[int] | None = None) -> Slopes:
        """
        :param index: of the parameters; default: all
        """
        every = np.arange(len(point.theta)) if index is None else np.array(index, int)
        step = eliminate_starts(self._blocks(point.theta, every, point.offsets), 0.0)
        return Slopes(step.curvature, step.scores)

    def nearest(
        self,
        theta: Float[np.ndarray, " p"],
        offsets: Sequence[Float[np.ndarray, "n free"]],
        measured: bool = False,
    ) -> tuple[Float[np.ndarray, "n free"], float]:
        """
        :param offsets: of the start states under other parameters, one or several
        :param measured: whether the measured start states are to choose from, too
        :return: of each window, the start state that explains it best; and the cost of that
        """
        every = [*offsets, self._measured(theta)] if measured else offsets
        costs = [self._blocks(theta, np.array([], int), each).cost for each in every]
        best = np.argmin(costs, 0)[None]
        chosen = np.take_along_axis(np.stack(every), best[..., None], 0)[0]
        return chosen, float(np.take_along_axis(np.stack(costs), best, 0).sum())

    def _measured(self, theta: np.ndarray) -> np.ndarray:
        h = self.hypotheses
        params = h.fixed | dict(zip(h.names, theta, strict=True))
        with jax.enable_x64(True):
            return first_offsets(h.twin, np.asarray(self.shots.obs, float), h.twin.dt, params)

    @cached_property
    def _most_known(self) -> int:
        """Of all windows, the most steps that were recorded before one."""
        return int(np.asarray(self.shots.lead_known).sum(1).max(initial=0.0))

    @cached_property
    def _portions(self) -> list[tuple[Shots, slice]]:
        """Windows, some at a time, the last ones padded."""
        found = []
        with jax.enable_x64(True):
            for first in range(0, self.shots.n, self.portion):
                index = np.minimum(np.arange(first, first + self.portion), self.shots.n - 1)
                portion = Shots(*(jnp.asarray(leaf[index], jnp.float64) for leaf in self.shots))
                found.append((portion, slice(first, min(first + self.portion, self.shots.n))))
        return found

    def _lead_under(self, theta: np.ndarray, index: np.ndarray) -> int:
        """:return: steps before a window in which memory must be filled under these parameters"""
        h = self.hypotheses
        active = theta != h.null
        # An effect at its null needs no memory, but its slope may need the last few commands.
        begins = np.where(
            active, h.memory_length, np.minimum(h.memory_length, Effect.forgets * h.period)
        )
        active[index] = True
        longest = max(h.always, float(begins[active].max(initial=0.0)))
        return min(n_steps_of(longest, h.twin.dt), self._most_known)

    def _blocks(self, theta: np.ndarray, index: np.ndarray, offsets: np.ndarray) -> Blocks:
        """Normal equations at a point, of the parameters named by ``index``."""

        def of(portion: tuple[Shots, slice]) -> Blocks:
            shots, rows = portion
            return self._portion(shots, theta, index, offsets[rows], rows.stop - rows.start)

        found = in_threads(of, self._portions)
        return Blocks(*map(np.concatenate, zip(*found, strict=True)))

    def _portion(
        self, shots: Shots, theta: np.ndarray, index: np.ndarray, offsets: np.ndarray, n: int
    ) -> Blocks:
        h, n_lead = self.hypotheses, self._lead_under(theta, index)
        filled = np.zeros((self.portion, offsets.shape[1]))
        filled[:n] = offsets
        n_steps = self.shots.obs[..., 0].size
        large = len(h.twin.joints) > _MANY_JOINTS or n_steps > _MANY_STEPS
        width, slopes = 0 if large and not len(index) else self.width, []
        for own in _in_groups(index, width, len(theta)):
            alone = _LAPACK if uses_lapack(len(h.twin.joints)) else nullcontext()
            with jax.enable_x64(True), alone:
                found = _errors_and_slopes(
                    h.twin,
                    h.names,
                    tuple(h.ties.items()),
                    h.fixed,
                    shots,
                    theta,
                    own,
                    filled,
                    h.scale,
                    n_lead,
                    h.chosen(theta, own),
                )
                found = [np.asarray(leaf)[:n] for leaf in found]
            residual, by_start, by_theta = found
            slopes.append(by_theta)
        by_theta = np.concatenate(slopes, -1)[..., : len(index)]
        counted = np.ones(residual.shape[1]) if self.rows is None else self.rows
        return normal_equations(residual, by_start, by_theta, self.noise, counted, self.threshold)


def in_threads(work: Callable[[_Given], _Told], given: Sequence[_Given]) -> Iterator[_Told]:
    """
    Like ``map``, in threads: compiled programs release the interpreter lock.
    """
    if len(given) == 1:
        yield work(given[0])
        return
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        yield from pool.map(work, given)


def _in_groups(index: np.ndarray, width: int, nothing: int) -> Iterator[np.ndarray]:
    """Indices, ``width`` at a time, the last ones padded with ``nothing``."""
    for first in range(0, max(len(index), 1), max(width, 1)):
        own = index[first : first + width]
        yield np.concatenate([own, np.full(width - len(own), nothing)])


@partial(jax.jit, static_argnums=(0, 1, 2), compiler_options=QUICK_COMPILATION)
def _errors_and_slopes(
    twin: Twin,
    names: tuple[str, ...],
    ties: tuple[tuple[str, tuple[str, ...]], ...],
    fixed: Params,
    shots: Shots,
    theta: Float[Array, " p"],
    index: Array,
    offsets: Float[Array, "n free"],
    scale: Float[Array, " p"],
    n_lead: Array,
    chosen: Chosen | None,
) -> tuple[Array, Array, Array]:
    """
    :param ties: parameters that share one value, by the name of that value
    :param n_lead: steps before each window that fill the memory
    :param chosen: the effects that may be active under these parameters; None: all
    :return: simulated minus measured, and its slopes by start state and by the parameters that
        ``index`` names (in units of their scale)
    """
    n, effects = offsets.shape[1], EffectChain((), {}, chosen)

    def one(offset: Array, shot: Shots) -> tuple[Array, Array, Array]:
        def of(both: Array) -> Array:
            # The last place takes the padding.
            step = jnp.zeros(len(names) + 1, theta.dtype).at[index].set(both[n:])
            values = theta + scale * step[:-1]
            params = fixed | {name: values[i] for i, name in enumerate(names)}
            for name, own in ties:
                for single in own:
                    params[single] = params[single] + params[name] - fixed[single]
            return simulate(twin, params, shot, offset + both[:n], n_lead, effects) - shot.obs

        error, slopes = with_slopes(of, jnp.zeros(n + index.shape[0], theta.dtype))
        return error, slopes[..., :n], slopes[..., n:]

    return jax.vmap(one)(offsets, shots)
