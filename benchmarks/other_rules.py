"""The verdicts of simpler rules on the same data: the peers of `hidden_effects.py`."""

from typing import NamedTuple

import numpy as np

# Required decrease of the information criterion: "very strong evidence" by the usual scale.
_STRONG = 10.0
# Threshold of the sparse regression, as a share of the standard deviation of the force.
_THRESHOLD = 0.1
_N_PRUNINGS = 10
# Hidden layer of the network, steps of its training, and their size.
_HIDDEN, _N_STEPS, _RATE = 16, 400, 0.02


class Answer(NamedTuple):
    """
    :param name: empty for none; a network has no names, it says "?"
    :param gain: share by which errors at the end of held-out windows fall; a network predicts
        forces only, so nothing is known of them
    """

    name: str = ""
    gain: float = 0.0


def answers_of(inquiry) -> dict[str, Answer]:
    """
    :param inquiry: a `sb3_hds.sysid.diagnosis.pipeline.Inquiry` that has run
    :return: the answer of each rule
    """
    search, h = inquiry.search, inquiry.hypotheses
    start = search.base(h.null, h.nuisances)
    tried = search.finalists(start, [])
    return {
        "naive BIC": by_bic(search, start, tried),
        "best held-out": by_held_out(search, start, tried),
        "all parameters": by_parameters(search, h, start),
        "sparse regression": by_regression(inquiry, start),
        "residual network": by_network(inquiry, start),
    }


def squares(search, point) -> float:
    return float(np.sum((point.residual / search.noise) ** 2))


def gain(search, start, kept) -> float:
    before, after = (
        np.mean((x.residual[:, -1] / search.noise) ** 2) for x in (start.held_out, kept)
    )
    return float(1.0 - after / before)


def by_bic(search, start, tried) -> Answer:
    """The lowest Bayesian information criterion, with every sample counted as independent."""
    n = start.point.residual.size
    before = squares(search, start.point)

    def criterion(t) -> float:
        lower = n * np.log(before / squares(search, t.point))
        return lower - len(t.candidate.parameters) * np.log(n)

    best = max(tried, key=criterion)
    if criterion(best) <= _STRONG:
        return Answer()
    return Answer(best.candidate.key, gain(search, start, best.held_out))


def by_held_out(search, start, tried) -> Answer:
    """The lowest error on held-out recordings, if it is lower at all."""
    best = min(tried, key=lambda t: squares(search, t.held_out))
    if squares(search, best.held_out) >= squares(search, start.held_out):
        return Answer()
    return Answer(best.candidate.key, gain(search, start, best.held_out))


def by_parameters(search, h, start) -> Answer:
    """Fit all parameters of the twin and name the one that changed most, in standard errors."""
    from sb3_hds.sysid.comparison.inference import standard_errors

    own = [h.indices(c)[0] for c in h.candidates if c.slot == "parameter"]
    free = [*start.free, *own]
    fitted = search.base(start.point.theta, free)
    if not own or squares(search, fitted.held_out) > 0.95 * squares(search, start.held_out):
        return Answer()
    stderr = standard_errors(search.select, fitted.point, free)
    moved = np.abs(fitted.point.theta - h.null)[own] / np.maximum(stderr[own], 1e-300)
    name = f"parameter.{h.names[own[int(np.argmax(moved))]]}"
    return Answer(name, gain(search, start, fitted.held_out))


def by_regression(inquiry, start) -> Answer:
    """Sequentially thresholded least squares (SINDy) on the residual force."""
    from sb3_hds.sysid.comparison.unexplained import residual_forces, short_windows, weighed

    select = inquiry.search.select.evidence
    wide = inquiry.given.period, 2 * inquiry.given.most_windows
    short = short_windows(select, start.point.theta, inquiry.given.data, *wide)
    residual = residual_forces(short, inquiry.given.data)
    twin, found = inquiry.hypotheses.twin, []
    weights = weighed(residual._replace(force=np.ones_like(residual.force)))
    for j, joint in enumerate(twin.joints):
        q, v = residual.position[:, j], residual.velocity[:, j]
        columns = {
            f"viscous_friction.{joint.name}": v,
            f"coulomb_friction.{joint.name}": np.sign(v),
            f"quadratic_drag.{joint.name}": v * np.abs(v),
            f"stiffness.{joint.name}": q,
            f"cubic_stiffness.{joint.name}": q**3,
            f"constant_force.{joint.name}": np.ones_like(q),
        }
        for k, actuator in enumerate(twin.actuators):
            columns[f"torque_gain.{actuator.name}"] = residual.command[:, k]
        force = weighed(residual)[:, j]
        matrix = np.stack(list(columns.values()), 1) * weights[:, j, None]
        moved = _sparse(matrix, force)
        best = int(np.argmax(np.abs(moved)))
        if moved[best]:
            found.append((abs(moved[best]), list(columns)[best]))
    if not found:
        return Answer()
    # The named causes are then fitted like all others.
    name, h = max(found)[1], inquiry.hypotheses
    chosen = [h.indices(c) for c in h.candidates if c.key == name]
    if not chosen:
        # The equation of motion left it out of what is simulated.
        return Answer(name)
    fitted = inquiry.search.base(start.point.theta, [*start.free, *chosen[0]])
    return Answer(name, gain(inquiry.search, start, fitted.held_out))


def _sparse(matrix: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Contribution of each column, in standard deviations of the force; 0 where it was pruned."""
    size = matrix.std(0) + 1e-300
    kept = np.ones(matrix.shape[1], bool)
    moved = np.zeros(matrix.shape[1])
    for _ in range(_N_PRUNINGS):
        moved[:] = 0.0
        if not kept.any():
            break
        answer = np.linalg.lstsq(matrix[:, kept], force, rcond=None)[0]
        moved[kept] = answer * size[kept] / force.std()
        again = kept & (np.abs(moved) > _THRESHOLD)
        if (again == kept).all():
            break
        kept = again
    return moved


def by_network(inquiry, start) -> Answer:
    """A network learns the residual force; an error is reported if it predicts held-out force."""
    import torch

    from sb3_hds.sysid.comparison.held_out import split
    from sb3_hds.sysid.comparison.unexplained import residual_forces, short_windows, weighed

    select = inquiry.search.select.evidence
    wide = inquiry.given.period, 2 * inquiry.given.most_windows
    short = short_windows(select, start.point.theta, inquiry.given.data, *wide)
    residual = residual_forces(short, inquiry.given.data)
    inputs = np.concatenate(
        [np.cos(residual.position), np.sin(residual.position), residual.velocity, residual.command],
        1,
    )
    inputs = (inputs - inputs.mean(0)) / (inputs.std(0) + 1e-9)
    held_out = split(inquiry.given.data, residual.origin, inquiry.seed).held_out
    x, y = (torch.tensor(a, dtype=torch.float32) for a in (inputs, weighed(residual)))
    torch.manual_seed(0)
    net = torch.nn.Sequential(
        torch.nn.Linear(x.shape[1], _HIDDEN), torch.nn.Tanh(), torch.nn.Linear(_HIDDEN, y.shape[1])
    )
    optimiser = torch.optim.Adam(net.parameters(), _RATE, weight_decay=1e-4)
    for _ in range(_N_STEPS):
        optimiser.zero_grad()
        torch.mean((net(x[~held_out]) - y[~held_out]) ** 2).backward()
        optimiser.step()
    with torch.no_grad():
        left = torch.sum((net(x[held_out]) - y[held_out]) ** 2)
    better = bool(left < torch.sum(y[held_out] ** 2))
    return Answer("?", np.nan) if better else Answer()
