"""
Trajectory optimisation on any twin.

Every improver is a function ``(problem, start, first, ...)`` on one trajectory, controls or a plan,
safe under ``jit`` and ``vmap``; :func:`solve` batches one over many start states.
"""

from sb3_hds.planning.batch import METHODS, solve
from sb3_hds.planning.expansion import Expansion, expand
from sb3_hds.planning.first_order import control_gradient, gradient_ascent
from sb3_hds.planning.ilqr import gauss_newton, ilqr, newton_direction
from sb3_hds.planning.line_search import choose, step_sizes
from sb3_hds.planning.problem import Plan, Problem, follow, score, simulate
from sb3_hds.planning.receding_horizon import receding_horizon
from sb3_hds.planning.riccati import Gains, solve_backward
from sb3_hds.planning.warm_start import (
    best_of_random,
    horizon_continuation,
    multi_start,
    random_controls,
)

__all__ = [
    "METHODS",
    "Expansion",
    "Gains",
    "Plan",
    "Problem",
    "best_of_random",
    "choose",
    "control_gradient",
    "expand",
    "follow",
    "gauss_newton",
    "gradient_ascent",
    "horizon_continuation",
    "ilqr",
    "multi_start",
    "newton_direction",
    "random_controls",
    "receding_horizon",
    "score",
    "simulate",
    "solve",
    "solve_backward",
    "step_sizes",
]
