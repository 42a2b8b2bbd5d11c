"""The differences between a corrected twin and its model file."""

import dataclasses

import numpy as np

from sb3_hds.core import ExtendedTwin, Twin
from sb3_hds.core.extended import with_native
from sb3_hds.core.twin import layers_of
from sb3_hds.twins.mujoco.mechanism import Body, Mechanism
from sb3_hds.twins.mujoco.parameters import bodies_of
from sb3_hds.twins.mujoco.rigid_body import algebra as alg
from sb3_hds.twins.mujoco.rigid_body import spatial
from sb3_hds.twins.mujoco.twin import MechanismTwin

OF_JOINTS = ("damping", "frictionloss", "armature", "stiffness")
DIGITS = 9
# Relative changes of a body below this are rounding errors.
_SAME = 1e-12


@dataclasses.dataclass
class Correction:
    """
    The differences to write into a model file, and a record of what was written.

    :param plant: the twin of the file, without effects
    :param values: parameters of the plant, changed by native effects
    :param effects: the other effects: name, index of the place, key and values of each
    :param changed: written changes, a line each
    :param left_out: changes that the format cannot express, a line each
    """

    plant: MechanismTwin
    values: dict[str, float]
    effects: list[tuple[str, int, str, dict[str, float]]]
    changed: list[str] = dataclasses.field(default_factory=list)
    left_out: list[str] = dataclasses.field(default_factory=list)

    @classmethod
    def of(cls, twin: Twin, plant: MechanismTwin) -> "Correction":
        values = {name: float(twin.values.get(name, plant.values[name])) for name in plant.values}
        still = [f"{name}, which the twin has locked" for name, _ in plant.mechanism.locked]
        found = cls(plant, values, [], left_out=still)
        for layer in layers_of(twin):
            if layer is plant:
                continue
            if not isinstance(layer, ExtendedTwin):
                found.left_out.append(f"{type(layer).__name__}, a layer around the twin")
                continue
            for a in layer.attached:
                own = {name: float(layer.values[f"{a.key}.{name}"]) for name in a.effect.parameters}
                native = plant.native_effects.get((a.effect.name, a.index))
                if native is None:
                    found.effects.append((a.effect.name, a.index, a.key, own))
                    continue
                for name, target in native.items():
                    parameter = a.effect.parameters[name]
                    values[target] = float(with_native(values[target], own[name], parameter))
        return found

    @property
    def mechanism(self) -> Mechanism:
        return self.plant.mechanism

    def difference(self, name: str) -> float:
        """:return: the change of a parameter relative to the file"""
        if name not in self.values:
            return 0.0
        return self.values[name] - self.plant.parameters[name].null

    def record_change(self, name: str) -> None:
        parameter = self.plant.parameters[name]
        value, unit = self.values[name], parameter.unit
        self.changed.append(f"{name}: {value:.6g} {unit} (was {parameter.null:.6g})")

    def record_left_out(self, name: str) -> None:
        self.left_out.append(f"{name}: {self.values[name]:.6g} {self.plant.parameters[name].unit}")

    def record_effect(self, key: str, own: dict[str, float], *, written: bool) -> None:
        lines = [f"{key}.{name}: {value:.6g}" for name, value in own.items()]
        (self.changed if written else self.left_out).extend(lines)


def changed_bodies(correction: Correction) -> dict[int, spatial.Body]:
    """:return: the bodies that differ from the file, by link"""
    mechanism, plant = correction.mechanism, correction.plant
    null = {name: parameter.null for name, parameter in plant.parameters.items()}
    with_body = [i for i, link in enumerate(mechanism.links) if link.body is not None]
    pairs = zip(
        with_body,
        *(bodies_of(mechanism, plant.payload, plant.masses, p) for p in (null, correction.values)),
        strict=True,
    )
    return {i: new for i, old, new in pairs if not np.allclose(_flat(old), _flat(new), _SAME, 0.0)}


def in_body_frame(body: Body, new: spatial.Body) -> tuple[float, np.ndarray, np.ndarray]:
    """
    :param body: as the file has it
    :param new: the same body, corrected, in the frame of its link
    :return: mass, centre of mass and second moments about it, in the frame of the body
    """
    rotation, origin = np.array(body.rotation), np.array(body.origin)
    centre = rotation.T @ (np.array(new.centre, float) - origin)
    second = rotation.T @ np.array(alg.full(new.second_moments), float) @ rotation
    return float(new.mass), centre, second


def _flat(body: spatial.Body) -> np.ndarray:
    return np.array([body.mass, *body.centre, *body.second_moments], float)
