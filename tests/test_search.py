"""The search for causes by simulation: what it answers depends on nothing that it was asked."""

import numpy as np
import pytest
from test_diagnose import TWIN, on_engine

from sb3_hds import effects
from sb3_hds.sysid.comparison.search import places_of
from sb3_hds.sysid.diagnosis.findings import _widened
from sb3_hds.sysid.diagnosis.pipeline import Inquiry

KINDS = (effects.ViscousFriction, effects.CoulombFriction, effects.StribeckFriction)


@pytest.fixture(scope="module")
def searched():
    inquiry = Inquiry(TWIN, on_engine(n=4, friction=0.1), KINDS, (), 0, "quick", False)
    inquiry.prepare()
    inquiry.settle_noise()
    return inquiry.search


def test_a_second_answer_is_the_first_whatever_was_asked_in_between(searched):
    start = searched.base(searched.hypotheses.null, ())
    first = searched.finalists(start, [])

    searched.screen(searched.believing(first[0], start), [first[0].candidate.key])
    searched.fit_aliased(first[0], first, start)
    searched.with_noise(10.0 * searched.noise).finalists(start, [])

    again = searched.finalists(start, [])
    assert [t.candidate.key for t in again] == [t.candidate.key for t in first]
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.point.theta, other.point.theta)
        np.testing.assert_array_equal(one.kept.raw, other.kept.raw)


def test_fits_begin_where_they_are_told_to(searched):
    start = searched.base(searched.hypotheses.null, ())
    best = searched.finalists(start, [])[0]

    (stopped,) = searched.fit([best.candidate], start, places_of([best]), n_steps=0)

    assert best.point.cost < start.point.cost
    assert stopped.point.cost == pytest.approx(best.point.cost, rel=1e-6)


def test_a_search_cannot_be_changed(searched):
    with pytest.raises(AttributeError):
        searched.places = {}


def test_intervals_of_several_causes_are_no_narrower_than_models_are_exact():
    low, high = _widened(2.0, 1.999, 2.003, 0.02)
    assert low == pytest.approx(2.0 - np.hypot(0.001, 0.02))
    assert high == pytest.approx(2.0 + np.hypot(0.003, 0.02))
