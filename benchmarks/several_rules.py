"""
What others would have said of data with several causes in them: the peers of `hidden_effects.py`.

    pip install pysindy

Three of them solve the equation of motion of the smoothed data, sample by sample, with the columns
that `diagnose` has: all effects of the catalogue and all parameters of the twin, at one value of
what is not linear in them. One fits everything at once by simulation. PySINDy is left out where it
is not installed.
"""

import importlib.util
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

# On machines of more joints, to fit every candidate alone by simulation takes far too long.
_FEW_JOINTS = 2
_CONFIDENCE = 0.9
_RIDGE = 1e-9
# Stability selection: blocks of rows of which half are drawn, how often, the share of draws in
# which a cause has to come up, and how many false ones are expected at most.
_BLOCKS, _DRAWS, _OFTEN, _FALSE = 20, 40, 0.8, 1.0
_PENALTIES, _SWEEPS = np.geomspace(1.0, 1e-4, 60), 20


class Regression(NamedTuple):
    """
    The equation of motion, all joints below one another, each in units of its missing force.

    :param missing: force, shape ``(n,)``
    :param columns: what candidates add, root mean square one, shape ``(n, k)``
    :param keys: name and place of the candidate of each column
    """

    missing: np.ndarray
    columns: np.ndarray
    keys: tuple[str, ...]

    def named(self, kept: np.ndarray) -> list[str]:
        """:return: candidates of which a column is kept, shape ``(k,)``"""
        return list(dict.fromkeys(key for key, own in zip(self.keys, kept, strict=True) if own))


class Answer(NamedTuple):
    """
    :param names: of causes, with their places
    :param seconds: that it took, data smoothed and columns made already
    """

    names: list[str]
    seconds: float


def asked(inquiry: Any, twin: Any, data: Any, budget: str) -> dict[str, Answer]:
    """
    :param inquiry: a `sb3_hds.sysid.diagnosis.pipeline.Inquiry` about these data
    :return: by rule, what it says
    """
    found: dict[str, Answer] = {}
    if inquiry.screened is not None:
        regression = regression_of(inquiry.screened)
        found["backward elimination"] = _timed(lambda: by_elimination(regression))
        found["forward BIC"] = _timed(lambda: by_forward_bic(regression))
        found["group lasso, stability"] = _timed(lambda: by_stability(regression, inquiry.seed))
        if importlib.util.find_spec("pysindy"):
            found["PySINDy's STLSQ"] = _timed(lambda: by_stlsq(regression))
    found["all fitted by simulation"] = _timed(lambda: by_simulation(twin, data, inquiry.seed))
    if len(twin.joints) <= _FEW_JOINTS:
        found["diagnose, one by one"] = _timed(lambda: one_by_one(twin, data, inquiry.seed, budget))
    return found


def _timed(rule: Callable[[], list[str]]) -> Answer:
    started = time.time()
    names = rule()
    return Answer(names, time.time() - started)


# ------------------------------------------------------------------------------ equation of motion
def regression_of(screened: Any) -> Regression:
    """:param screened: a `sb3_hds.sysid.equation.screening.Screened`"""
    from sb3_hds.sysid.equation.assembly import assemble
    from sb3_hds.sysid.equation.terms import terms

    motion, twin = screened.motion, screened.hypotheses.nominal
    made = assemble(screened.hypotheses, motion)
    q, v, change, actions = (
        np.concatenate(parts)
        for parts in zip(
            *((r.q[:-1], r.v[:-1], np.diff(r.v, axis=0), r.actions) for r in motion.recordings),
            strict=True,
        )
    )
    nominal = terms(twin, twin.params, q, v, actions)
    missing = np.einsum("nij,nj->ni", made.effective_inertia, change - nominal.change) / motion.dt
    unit = np.sqrt(np.mean(missing**2, axis=0)) + 1e-300
    columns, keys = [], []
    for item in _at_one_setting(made.items):
        for c in item.free:
            column = made.columns[c]
            table = np.zeros_like(missing)
            table[:, slice(None) if column.joint is None else column.joint] = column.values
            columns.append((table / unit).ravel())
            keys.append(item.key)
    x = np.stack(columns, 1)
    size = np.sqrt(np.mean(x**2, axis=0)) + 1e-300
    return Regression((missing / unit).ravel(), x / size, tuple(keys))


def _at_one_setting(items: list[Any]) -> Iterator[Any]:
    """Of what has several settings, the middle one; of a delay and the like, the first."""
    by_key: dict[str, list[Any]] = {}
    for item in items:
        by_key.setdefault(item.key, []).append(item)
    for own in by_key.values():
        yield own[0] if own[0].rule == "chain" else own[len(own) // 2]


def by_elimination(given: Regression) -> list[str]:
    """All columns; the one that t doubts most leaves, until Schwarz's criterion would rise."""
    x, y = given.columns, given.missing
    gram, right, n = x.T @ x, x.T @ y, len(y)
    kept = list(range(x.shape[1]))
    while kept:
        inverse = np.linalg.inv(gram[np.ix_(kept, kept)] + _RIDGE * n * np.eye(len(kept)))
        theta = inverse @ right[kept]
        rss = max(float(y @ y - theta @ right[kept]), 1e-300)
        t = theta**2 / (np.diag(inverse) * rss / max(n - len(kept), 1))
        if t.min() > np.log(n):
            break
        kept.pop(int(np.argmin(t)))
    return given.named(np.isin(np.arange(x.shape[1]), kept))


def by_forward_bic(given: Regression) -> list[str]:
    """From nothing, add the candidate that lowers Schwarz's criterion most, while one does."""
    x, y, n = given.columns, given.missing, len(given.missing)
    gram, right, total = x.T @ x, x.T @ y, float(y @ y)
    keys, chosen = np.array(given.keys), np.zeros(x.shape[1], bool)

    def criterion(kept: np.ndarray) -> float:
        own = np.flatnonzero(kept)
        inner = gram[np.ix_(own, own)] + _RIDGE * n * np.eye(len(own))
        rss = total - right[own] @ np.linalg.solve(inner, right[own]) if len(own) else total
        return n * np.log(max(float(rss), 1e-300)) + len(own) * np.log(n)

    best = criterion(chosen)
    while not chosen.all():
        trials = [chosen | (keys == key) for key in dict.fromkeys(keys[~chosen])]
        values = [criterion(trial) for trial in trials]
        if min(values) >= best:
            break
        best, chosen = min(values), trials[int(np.argmin(values))]
    return given.named(chosen)


def by_stlsq(given: Regression) -> list[str]:
    """Sequentially thresholded ridge regression, with PySINDy's own settings."""
    from pysindy.optimizers import STLSQ

    fitted = STLSQ().fit(given.columns, given.missing[:, None])
    return given.named(np.ravel(fitted.coef_) != 0.0)


def by_stability(given: Regression, seed: int) -> list[str]:
    """
    Group lasso with stability selection (Yuan and Lin 2006; Meinshausen and Buehlmann 2010): what
    comes first in most half samples, so many at a time that no more than one is expected by chance.
    """
    names = list(dict.fromkeys(given.keys))
    groups = [np.flatnonzero(np.array(given.keys) == name) for name in names]
    x = given.columns.copy()
    for own in groups:
        x[:, own] = np.linalg.qr(x[:, own])[0] * np.sqrt(len(x))
    blocks = np.array_split(np.arange(len(x)), _BLOCKS)
    grams = np.stack([x[b].T @ x[b] for b in blocks])
    rights = np.stack([x[b].T @ given.missing[b] for b in blocks])
    most = max(1, round(np.sqrt((2.0 * _OFTEN - 1.0) * len(names) * _FALSE)))
    rng, came = np.random.default_rng(seed), np.zeros(len(names))
    for _ in range(_DRAWS):
        half = rng.permutation(_BLOCKS)[: _BLOCKS // 2]
        came += _first_groups(grams[half].sum(0), rights[half].sum(0), groups, most)
    return [name for name, n in zip(names, came, strict=True) if n >= _OFTEN * _DRAWS]


def _first_groups(
    gram: np.ndarray, right: np.ndarray, groups: list[np.ndarray], most: int
) -> np.ndarray:
    """:return: whether each is in the model before more than so many are, by coordinate descent"""
    theta, weights = np.zeros(len(right)), [np.sqrt(len(own)) for own in groups]
    size = float(np.mean(np.diag(gram)))
    strongest = max(np.linalg.norm(right[own]) / w for own, w in zip(groups, weights, strict=True))
    active = np.zeros(len(groups), bool)
    for penalty in strongest * _PENALTIES:
        for _ in range(_SWEEPS):
            for own, weight in zip(groups, weights, strict=True):
                left = right[own] - gram[own] @ theta + size * theta[own]
                shrunk = 1.0 - penalty * weight / (np.linalg.norm(left) + 1e-300)
                theta[own] = max(shrunk, 0.0) * left / size
        now = np.array([bool(np.any(theta[own])) for own in groups])
        if now.sum() > most:
            break
        active = now
    return active


# ------------------------------------------------------------------------------ simulation
def by_simulation(twin: Any, data: Any, seed: int) -> list[str]:
    """
    Fit frictions, springs, offsets, gains and all parameters of the twin at once, as MuJoCo's
    toolbox for system identification does; what has an interval without its null is a cause.
    """
    from sb3_hds import effects
    from sb3_hds.sysid.comparison.inference import standard_errors
    from sb3_hds.sysid.diagnosis.pipeline import Inquiry

    kinds = (
        effects.ViscousFriction,
        effects.CoulombFriction,
        effects.Stiffness,
        effects.ConstantForce,
        effects.TorqueGain,
    )
    with _without_screening():
        inquiry = Inquiry(twin, data, kinds, (), seed, "full", False)
    if inquiry.given.convention is not None or inquiry.given.reason_to_refuse:
        return []
    inquiry.split_halves()
    search, h = inquiry.search, inquiry.hypotheses
    own = [c for c in h.candidates if not c.key.endswith(".all")]
    free = sorted({i for c in own for i in h.indices(c)})
    fitted = search.base(h.null, free)
    # What the fit leaves is the noise of each channel.
    search = search.with_noise(np.sqrt(np.mean(fitted.point.residual**2, (0, 1))) + 1e-300)
    whole, point = search.pooled(search.refit(fitted))
    stderr = standard_errors(whole, point, free)
    wide = stats.norm.ppf(0.5 + _CONFIDENCE / 2.0) * stderr
    moved = np.abs(point.theta - h.null) > wide
    sizes = {c.key: [i for i in h.indices(c) if not h.names[i].endswith(".q0")] for c in own}
    return [key for key, index in sizes.items() if moved[index].any()]


def one_by_one(twin: Any, data: Any, seed: int, budget: str) -> list[str]:
    """`diagnose` without the stage of several causes: candidates alone, each by simulation."""
    from sb3_hds import effects
    from sb3_hds.sysid.diagnosis.pipeline import Inquiry

    with _without_screening():
        inquiry = Inquiry(twin, data, effects.ALL, (), seed, budget, False)
    if inquiry.given.reason_to_refuse:
        return []
    return [finding.key for finding in inquiry.run().findings]


@contextmanager
def _without_screening() -> Iterator[None]:
    """Nothing is proposed by equation errors: every candidate is simulated."""
    from sb3_hds.sysid.diagnosis import preparation

    screen = preparation.screen
    preparation.screen = lambda *_: None
    try:
        yield
    finally:
        preparation.screen = screen
