"""The search for causes by simulation: what it answers depends on nothing that it was asked."""

from types import SimpleNamespace

import numpy as np
import pytest
import scipy
from test_diagnose import TWIN, on_engine

from sb3_hds import effects
from sb3_hds.sysid.comparison import several
from sb3_hds.sysid.comparison.halves import Accepted
from sb3_hds.sysid.comparison.search import Place
from sb3_hds.sysid.diagnosis.findings import finding
from sb3_hds.sysid.diagnosis.pipeline import Inquiry

KINDS = (effects.ViscousFriction, effects.CoulombFriction, effects.StribeckFriction)


@pytest.fixture(scope="module")
def searched():
    inquiry = Inquiry(TWIN, on_engine(n=4, friction=0.1), KINDS, (), 0, "quick", False)
    inquiry.split_halves()
    inquiry.settle_noise()
    return inquiry.search


def test_a_second_answer_is_the_first_whatever_was_asked_in_between(searched):
    start = searched.base(searched.hypotheses.null, ())
    first = searched.finalists(start, [])

    searched.fit_roughly(searched.believing(first[0], start), [first[0].candidate.key])
    searched.fit_aliased(first[0], first, start)
    searched.with_noise(10.0 * searched.noise).finalists(start, [])

    again = searched.finalists(start, [])
    assert [t.candidate.key for t in again] == [t.candidate.key for t in first]
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.point.theta, other.point.theta)
        np.testing.assert_array_equal(one.held_out.residual, other.held_out.residual)


def test_fits_begin_where_they_are_told_to(searched):
    start = searched.base(searched.hypotheses.null, ())
    best = searched.finalists(start, [])[0]
    own = list(searched.hypotheses.indices(best.candidate))
    nearly = start.point.theta + 0.9 * (best.point.theta - start.point.theta)
    there = {best.candidate.key: Place(nearly, best.point.offsets, ())}

    (stopped,) = searched.fit([best.candidate], start, there, n_steps=0)

    np.testing.assert_array_equal(stopped.point.theta[own], nearly[own])
    assert best.point.cost < stopped.point.cost < start.point.cost


def test_a_search_cannot_be_changed(searched):
    with pytest.raises(AttributeError):
        searched.places = {}


@pytest.mark.parametrize("of_equation", [True, False])
def test_intervals_of_several_causes_are_no_narrower_than_models_are_exact(searched, of_equation):
    start = searched.base(searched.hypotheses.null, ())
    best = searched.finalists(start, [])[0]
    whole, point = searched.pooled(searched.believing(best, start))
    free = searched.hypotheses.indices(best.candidate)
    exact = {name: (2.0, 2.0, 2.0) for name in best.candidate.parameters}
    verdict = searched.ranking.compare(best.held_out, start.held_out)
    alone = Accepted(best, verdict, (), 0.0)
    among = alone._replace(sizes=exact, of_equation=of_equation)
    if not of_equation:
        exact = {n: (point.theta[i],) * 3 for n, i in zip(exact, free, strict=True)}
        among = among._replace(sizes=exact)

    plain, wide = (finding(one, whole, point, free, False).parameters for one in (alone, among))

    for name, one in wide.items():
        reach = plain[name].high - plain[name].estimate
        expected = np.hypot(0.0 if of_equation else reach, 0.01 * one.estimate)
        assert one.high - one.estimate == pytest.approx(expected, rel=1e-6)


def test_a_member_of_a_set_is_the_best_of_all_candidates_also_of_those_not_simulated():
    candidate = SimpleNamespace(key="cogging.hinge")
    member = SimpleNamespace(t=4.0, gain=30.0, others=())
    screened = SimpleNamespace(hypotheses=SimpleNamespace(candidates=range(40)))
    base = SimpleNamespace(point=None, held_out=None)
    judged = several._Judged(screened, base, {candidate.key: None}, {})
    search = SimpleNamespace(hypotheses=SimpleNamespace(candidates=range(5)))

    found = several._accepted(search, candidate, member, [candidate.key], judged, candidate.key)

    # Eight folds.
    assert found.family_p_value == pytest.approx(40 * scipy.stats.t.sf(4.0, 7))
