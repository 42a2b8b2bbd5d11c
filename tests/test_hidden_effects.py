"""
Something is hidden in data of MuJoCo's engine, and `diagnose` must find it, or say that nothing is.

What is hidden depends on ``SB3_HDS_SALT``: continuous integration draws a new number each time.
"""

import os

import hidden_effects
import pytest

# Twenty diagnoses take some ten minutes.
pytestmark = [pytest.mark.expensive, pytest.mark.timeout(3600)]

SALT = int(os.environ.get("SB3_HDS_SALT", "0"))
N_CASES = 20


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    patch = pytest.MonkeyPatch()
    patch.setattr(hidden_effects, "CACHE", tmp_path_factory.mktemp("cache"))
    rows, case = [], 1_000_000 + 1000 * SALT
    while len(rows) < N_CASES:
        system = ("pendulum", "linear_axis")[case % 2]
        row = hidden_effects.run(system, case, "quick", "1 %", most=10, rules=False)
        rows += [row] if row else []
        case += 1
    patch.undo()
    print(f"SB3_HDS_SALT={SALT}")
    return rows


def spoken(row):
    return row["verdict"] in ("named", "ambiguous")


def test_nothing_is_named_where_nothing_was_hidden(table):
    nulls = [row for row in table if row["kind"].startswith("null")]
    alarms = [row for row in nulls if spoken(row)]
    # At most 2.5 % of nulls: two of seven are seen once in 80 runs.
    assert len(alarms) <= 1, alarms


def test_names_are_right(table):
    named = [row for row in table if row["kind"] == "effect" and spoken(row)]
    wrong = [row for row in named if not hidden_effects.hit(row["truth"], row["set"])]
    # At least 95 % of the sets: three of ten are missed once in 90 runs.
    assert len(wrong) <= 2, wrong


def test_what_shows_is_found(table):
    clear = [
        row
        for row in table
        if row["kind"] == "effect" and row["factor"] >= 4.0 and not row["disturbed"]
    ]
    missed = [row for row in clear if not hidden_effects.hit(row["truth"], row["set"])]
    assert len(missed) <= 1 + len(clear) // 4, missed


def test_standing_still_says_nothing(table):
    still = [row for row in table if row["kind"] == "still"]
    assert all(row["verdict"] == "not_identifiable" for row in still)
