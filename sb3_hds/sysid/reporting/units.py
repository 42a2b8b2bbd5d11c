"""Sizes of candidates, with their units."""

from collections.abc import Mapping

import numpy as np

from sb3_hds.core import Effect, Twin
from sb3_hds.effects import ALL
from sb3_hds.errors import EffectError


def with_unit(number: str, unit: str) -> str:
    """Without a break between them."""
    return number if unit == "1" else f"{number} {unit}".strip().replace(" ", "\N{NO-BREAK SPACE}")


def sizes_in_words(twin: Twin, key: str, sizes: Mapping[str, float]) -> str:
    """
    :param key: of a candidate of this twin
    :param sizes: by short name of the parameter
    :return: those that are finite
    """
    shown = [
        f"{name} {with_unit(f'{value:.2g}', _unit(twin, key, name))}"
        for name, value in sizes.items()
        if np.isfinite(value)
    ]
    return ", ".join(shown)


def _unit(twin: Twin, key: str, name: str) -> str:
    """Unit of a candidate's parameter; empty for an effect that is not of the catalogue."""
    effect, _, place = key.partition(".")
    full = place if effect == "parameter" else f"{key}.{name}"
    kinds: dict[str, type[Effect]] = {kind.name: kind for kind in ALL}
    if full not in twin.parameters and effect in kinds:
        try:
            twin = twin.extend(kinds[effect](place))
        except EffectError:
            return ""
    return twin.parameters[full].unit if full in twin.parameters else ""
