"""Rates with their intervals and targets, for the tables of `hidden_effects.py`."""

import json
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd


class Score(NamedTuple):
    """
    :param label: what is counted
    :param value: share or median
    :param low: lower end of its 95 % Wilson interval; nan if there is none
    :param high: upper end
    :param n: number of cases
    :param least: target: at least this value
    :param most: target: at most this value
    """

    label: str
    value: float
    low: float
    high: float
    n: int
    least: float | None = None
    most: float | None = None

    @property
    def target(self) -> str:
        ends = [f"at least {self.least:g}"] if self.least is not None else []
        ends += [f"at most {self.most:g}"] if self.most is not None else []
        return ", ".join(ends)

    @property
    def reached(self) -> str:
        if not self.target or not np.isfinite(self.value):
            return ""
        enough = self.least is None or self.value >= self.least
        return "yes" if enough and (self.most is None or self.value <= self.most) else "no"


def wilson(hits: int, n: int) -> tuple[float, float]:
    """:return: 95 % interval of a share"""
    from scipy.stats import binomtest

    if not n:
        return np.nan, np.nan
    found = binomtest(hits, n).proportion_ci(method="wilson")
    return float(found.low), float(found.high)


def share(label: str, hits: Any, **target: float) -> Score:
    """:param hits: for each case, whether it counts as a hit"""
    hits = np.asarray(hits, bool)
    n = len(hits)
    return Score(label, hits.mean() if n else np.nan, *wilson(int(hits.sum()), n), n, **target)


def middle(label: str, values: Any, at: float = 0.5, **target: float) -> Score:
    """:return: a quantile"""
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    value = float(np.quantile(values, at)) if len(values) else np.nan
    return Score(label, value, np.nan, np.nan, len(values), **target)


def sizes_of(rows: pd.DataFrame) -> tuple[list[bool], list[float]]:
    """
    :return: for each parameter of a right name, whether its interval covers the true value, and its
        relative error
    """
    covered, errors = [], []
    for text in rows["estimate"]:
        for value, low, high, true in json.loads(text or "{}").values():
            # Zero is a bound of the parameter, where an interval that ends at zero says little.
            if true:
                covered.append(low <= true <= high)
                errors.append(abs(value - true) / abs(true))
    return covered, errors


def share_with_interval(hits: Any) -> str:
    hits = np.asarray(hits, bool)
    if not len(hits):
        return "-"
    low, high = wilson(int(hits.sum()), len(hits))
    return f"{hits.mean():.2f} [{low:.2f}, {high:.2f}] of {len(hits)}"


def as_table(found: Sequence[Score]) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "what": s.label,
            "measured": f"{s.value:.3g}" if np.isfinite(s.value) else "-",
            "95 % interval": "" if np.isnan(s.low) else f"{s.low:.3f} to {s.high:.3f}",
            "of": s.n,
            "target": s.target,
            "reached": s.reached,
        }
        for s in found
    )
