"""How fast motions that start side by side part, which limits how long a prediction can be."""

import numpy as np

from sb3_hds.core import Twin
from sb3_hds.sysid.equation.motion import Motion
from sb3_hds.sysid.equation.terms import terms

# Rows at which the twin is linearised, and finite differences in shares of the motion.
_SOME, _STEP = 64, 1e-5


def divergence_rate(twin: Twin, motion: Motion) -> float:
    """
    :param twin: at the interval of the data
    :param motion: of the joints
    :return: greatest rate [1/s] at which a small change of the state grows along the recordings,
        from eigenvalues of the linearised step, in which positions follow the new velocities;
        zero where none grows
    """
    twin, dt, dof = motion.twin(twin), motion.dt, len(motion.period)
    parts = [(r.q[:-1], r.v[:-1], r.actions) for r in motion.recordings]
    q, v, u = map(np.concatenate, zip(*parts, strict=True))
    chosen = np.linspace(0, len(u) - 1, min(_SOME, len(u))).astype(int)
    q, v, u = q[chosen], v[chosen], u[chosen]
    steps = _STEP * np.diag(np.concatenate([_positive(motion.excursion), _positive(motion.speed)]))
    moved = [np.zeros(2 * dof), *steps]
    states = np.concatenate([np.concatenate([q, v], 1) + step for step in moved])
    commands = np.tile(u, (len(moved), 1))
    q, v = states[:, :dof], states[:, dof:]
    pushed = terms(twin, twin.params, q, v, commands, recorded=False).change
    pushed = pushed.reshape(len(moved), len(u), dof)
    by_state = (pushed[1:] - pushed[0]) / np.diag(steps)[:, None, None]
    faster = np.concatenate([np.zeros((dof, dof)), np.eye(dof)], 1) + by_state.transpose(1, 2, 0)
    further = np.concatenate([np.eye(dof), np.zeros((dof, dof))], 1) + dt * faster
    slopes = np.concatenate([further, faster], 1)
    slopes = slopes[np.isfinite(slopes).all((1, 2))]
    if not len(slopes):
        return 0.0
    growth = float(np.abs(np.linalg.eigvals(slopes)).max())
    return max(np.log(growth), 0.0) / dt if growth > 0.0 else 0.0


def _positive(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0.0, x, 1.0)
