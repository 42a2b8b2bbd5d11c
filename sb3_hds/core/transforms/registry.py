"""The transforms that can be rebuilt from saved data, by name."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

from sb3_hds.core.transforms.barrier import Barrier
from sb3_hds.core.transforms.base import ActionTransform, ObservationTransform, StatefulTransform
from sb3_hds.core.transforms.continuity import Continuity
from sb3_hds.core.transforms.cpg import Rhythm
from sb3_hds.core.transforms.filters import Delay, LowPass, RateLimit, Scale
from sb3_hds.core.transforms.history import History
from sb3_hds.core.transforms.rescale import RescaleAction, RescaleObservation
from sb3_hds.errors import ParameterError

Transform = ObservationTransform | ActionTransform | StatefulTransform


#: The transforms that can be rebuilt from saved data without naming their classes.
TRANSFORMS: tuple[type[Transform], ...] = (
    RescaleAction,
    RescaleObservation,
    RateLimit,
    LowPass,
    Delay,
    Scale,
    History,
    Barrier,
    Continuity,
    Rhythm,
)


def transform_to_spec(transform: Transform) -> dict[str, Any]:
    """:return: plain data from which :func:`transform_from_spec` makes an equal transform"""
    fields = {f.name: getattr(transform, f.name) for f in dataclasses.fields(transform)}
    return {"transform": transform.name} | fields


def transform_from_spec(
    spec: Mapping[str, Any], known: Iterable[type[Transform]] = TRANSFORMS
) -> Transform:
    """
    :param spec: what :func:`transform_to_spec` returned
    :param known: the classes among which the transform is found by name
    :raises ParameterError: if it is not among them
    """
    by_name = {transform.name: transform for transform in known}
    if spec["transform"] not in by_name:
        raise ParameterError(
            f"A twin was saved with the transform '{spec['transform']}', which is not known here. "
            f"Known are: {', '.join(by_name)}."
        )
    fields = {name: value for name, value in spec.items() if name != "transform"}
    return by_name[spec["transform"]](**fields)
