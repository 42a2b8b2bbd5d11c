"""What a twin is made of: effects and wrappers around the plant."""

from collections.abc import Iterator
from typing import Any

from sb3_hds.core.twin import Twin


def layers_of(twin: Twin) -> Iterator[Twin]:
    """:return: the twin, what it wraps, what that wraps, ..., last the plant"""
    layer: Any = twin
    while layer is not None:
        yield layer
        layer = getattr(layer, "base", None)


def plant_of(twin: Twin) -> Twin:
    """:return: the twin without any effect or wrapper"""
    *_, plant = layers_of(twin)
    return plant
