"""
Trajectory optimisation on any twin.

Every improver is a function ``(problem, start, first, ...)`` on one trajectory, controls or a plan,
safe under ``jit`` and ``vmap``; :func:`solve` batches one over many start states.
"""

from sb3_hds.planning.controller import MPC, mpc
from sb3_hds.planning.expansion import Expansion, expand
from sb3_hds.planning.ilqr import Gains, gauss_newton, ilqr, newton_direction, solve_backward
from sb3_hds.planning.line_search import choose, control_gradient, gradient_ascent, step_sizes
from sb3_hds.planning.problem import Plan, Problem, follow, score, simulate
from sb3_hds.planning.solve import (
    METHODS,
    best_of_random,
    horizon_continuation,
    multi_start,
    random_controls,
    receding_horizon,
    solve,
)

__all__ = [
    "METHODS",
    "MPC",
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
    "mpc",
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
