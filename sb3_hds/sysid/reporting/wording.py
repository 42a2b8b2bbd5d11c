"""Phrases that the printed result and the report share."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from sb3_hds.core import Effect, Twin
from sb3_hds.effects import ALL
from sb3_hds.errors import EffectError
from sb3_hds.sysid.estimation.results import Estimate

#: names of the simulations in which policies are trained
TRAINED_IN = {
    "believed": "the twin as believed",
    "extended": "the extended twin",
    "true": "the true twin",
}

#: why a candidate is rejected that predicts hardly better than the nominal model
TOO_LITTLE = "gains too little"
HORIZONS = "Held-out error by steps ahead, in units of what the best fit leaves"
ALIKE = "The data cannot tell it from:"
REJECTED = (
    "gain: by how much the candidate lowers the mean square error of held-out recordings; p: that "
    "chance alone would do as much"
)
PAIRED = "gain, paired"


def share_in_words(gain: float) -> str:
    """:return: a relative gain as a percentage; empty for NaN"""
    if math.isnan(gain):
        return ""
    # Adding zero turns -0 into 0.
    return "far worse" if gain < -1.0 else f"{round(gain, 2) + 0.0:.0%}"


def p_value_in_words(p_value: float) -> str:
    """:return: a p-value with two digits; empty for NaN"""
    return "" if math.isnan(p_value) else f"{p_value:.2g}"


def size_in_words(one: Estimate) -> str:
    """:return: the estimate with its unit, and the twin's own value that it is added to"""
    size = with_unit(f"{one.estimate:.4g}", one.unit)
    if not one.added_to:
        return size
    return f"{size}, added to the twin's own {with_unit(f'{one.added_to:.4g}', one.unit)}"


def interval_in_words(one: Estimate) -> str:
    """:return: the ends of the interval"""
    return f"{one.low:.4g} to {one.high:.4g}"


def evidence_in_words(gain: float, p_value: float) -> str:
    """:return: a sentence on the evidence for a cause"""
    return (
        f"It lowers the mean square error of held-out recordings by {share_in_words(gain)} "
        f"(p = {p_value_in_words(p_value)})."
    )


def explained_in_words(share: float) -> str:
    """:param share: of the predictable residual force"""
    return f"What was found explains {share:.0%} of the force that is missing and can be predicted."


class PolicyWords(NamedTuple):
    """
    Comparison of policies from several simulations, in words.

    :param measured: what was measured
    :param columns: titles of the table
    :param rows: of the table
    :param notes: one sentence each
    """

    measured: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...]


def policy_in_words(gain: Mapping[str, Any]) -> PolicyWords:
    """:param gain: ``PolicyGain.to_dict()``"""
    runs, episodes, simulations = gain["runs"], gain["episodes"], gain["simulations"]
    found = {TRAINED_IN[name]: one for name, one in simulations.items()} | {PAIRED: gain["gain"]}
    starts = f"{episodes} start {'states' if episodes > 1 else 'state'}"
    over = f"over {runs} runs of {starts} each" if runs > 1 else f"over {starts}, one run"
    columns = ("trained in", "return")
    rows = [(name, f"{one['mean']:.1f}") for name, one in found.items()]
    if runs > 1:
        columns += ("90 % interval over runs",)
        ends = [f"{one['low']:.1f} to {one['high']:.1f}" for one in found.values()]
        rows = [(*row, interval) for row, interval in zip(rows, ends, strict=True)]
    notes = [_paired_in_words(gain)]
    if runs == 1:
        notes.insert(0, "One run in each simulation tells nothing of how others would differ.")
    if gain["share_of_ceiling"] is not None:
        notes.append(f"{gain['share_of_ceiling']:.0%} of the gap to the true twin is closed.")
    measured = f"Return on the real system, interquartile mean {over}"
    return PolicyWords(measured, columns, tuple(rows), tuple(notes))


def _paired_in_words(gain: Mapping[str, Any]) -> str:
    alike = "of the same seed from the same start" if gain["runs"] > 1 else "from the same start"
    told = f"{PAIRED}: interquartile mean of the differences between returns {alike}"
    extended, believed = (gain["simulations"][name]["mean"] for name in ("extended", "believed"))
    difference = f"{extended - believed:.1f}"
    if difference == f"{gain['gain']['mean']:.1f}":
        return f"{told}."
    return (
        f"{told}. The means themselves differ by {difference}: each leaves out its own best and "
        "worst quarter."
    )


def with_unit(number: str, unit: str) -> str:
    """:return: number and unit, joined by a no-break space"""
    return number if unit == "1" else f"{number} {unit}".strip().replace(" ", "\N{NO-BREAK SPACE}")


def sizes_in_words(twin: Twin, key: str, sizes: Mapping[str, float]) -> str:
    """
    :param key: of a candidate of this twin
    :param sizes: by short name of the parameter
    :return: the finite ones, with their units
    """
    shown = [
        f"{name} {with_unit(f'{value:.2g}', _unit(twin, key, name))}"
        for name, value in sizes.items()
        if np.isfinite(value)
    ]
    return ", ".join(shown)


def _unit(twin: Twin, key: str, name: str) -> str:
    """Unit of a candidate's parameter; empty for an effect that is not in the catalogue."""
    effect, _, place = key.partition(".")
    full = place if effect == "parameter" else f"{key}.{name}"
    kinds: dict[str, type[Effect]] = {kind.name: kind for kind in ALL}
    if full not in twin.parameters and effect in kinds:
        try:
            twin = twin.extend(kinds[effect](place))
        except EffectError:
            return ""
    return twin.parameters[full].unit if full in twin.parameters else ""
