"""Candidates: every effect at every place, and every parameter of the twin."""

import dataclasses
from collections.abc import Callable, Collection, Sequence

import jax
import jax.numpy as jnp

from sb3_hds.core import ActionEffect, Effect, ExtendedTwin, ForceEffect, SensorEffect, Twin
from sb3_hds.core.twin import layers_of, plant_of
from sb3_hds.effects import (
    ActionDelay,
    DryFriction,
    NeuralForce,
    SensorDelay,
    SignFlip,
    reversed_joint,
)
from sb3_hds.errors import EffectError
from sb3_hds.sysid.motion.joints import encoders

# Longest delay, in periods of the motion; speed below which dry friction is smoothed, in units of
# the root mean square speed.
_LATEST, _STANDSTILL = 0.3, 0.01

#: the slot of a twin's own parameter, beside those of effects
PARAMETER = "parameter"

#: place of an effect that all actuators share
EVERY = "all"
# Effects that they may share: those of a bus or a controller.
_SHARED = ("action_delay", "motor_lag")
# Effects of an encoder that also act on the velocity derived from it.
_DERIVED = ("sensor_scale", "sensor_delay")
_OF_DIRECTION = "The direction of the joint is taken the wrong way round, in position and velocity."


@dataclasses.dataclass(frozen=True)
class Candidate:
    """
    A cause that data may confirm.

    :param name: of the effect; ``"parameter.mass"`` for a parameter of the twin
    :param slot: ``"joint"``, ``"actuator"``, ``"channel"`` or ``"parameter"``
    :param place: name of the joint, actuator or channel; of the parameter
    :param index: of the joint, actuator or channel, -1 for all actuators; of the parameter among
        those of the twin
    :param parameters: full names in the extended twin
    :param explanation: one sentence for people
    :param equivalents: effects that may be indistinguishable from this one, and under which motion
    :param ascending: parameters that must be in ascending order
    """

    name: str
    slot: str
    place: str
    index: int
    parameters: tuple[str, ...]
    explanation: str
    equivalents: tuple[tuple[str, str], ...] = ()
    ascending: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """Name and place: unique."""
        return self.name if self.slot == PARAMETER else f"{self.name}.{self.place}"

    @property
    def full_names(self) -> dict[str, str]:
        """Full names of its parameters by the short ones; the twin's own have no other name."""
        if self.slot == PARAMETER:
            return {self.place: self.place}
        return {name.rpartition(".")[2]: name for name in self.parameters}

    def moved_to(self, slot: str, place: str, index: int) -> "Candidate":
        """:return: the same effect at another place"""
        names = tuple(f"{self.name}.{place}.{short}" for short in self.full_names)
        return dataclasses.replace(self, slot=slot, place=place, index=index, parameters=names)

    def resembles(self, other: "Candidate") -> str:
        """
        :return: when it is indistinguishable from another one, as declared by the effect; empty
            otherwise
        """
        elsewhere = other.slot == self.slot and other.index != self.index
        return "" if elsewhere else dict(self.equivalents).get(other.name, "")


def single_keys(keys: Collection[str], twin: Twin) -> set[str]:
    """:return: keys of single effects: of a candidate at several places, those at each of them"""
    found = set(keys)
    for key in keys:
        name, _, place = key.partition(".")
        if place == EVERY:
            found |= {f"{name}.{actuator.name}" for actuator in twin.actuators}
        if name in (SignFlip.name, *_DERIVED):
            found |= {f"{name}.{channel.name}" for channel in twin.channels}
    return found


def options_for(
    period: float, speeds: Sequence[float], kind: type[Effect], place: int
) -> dict[str, float]:
    """:return: options of an effect that depend on the scales of the motion"""
    if issubclass(kind, ActionDelay | SensorDelay):
        return {"longest": _LATEST * period}
    if issubclass(kind, DryFriction) and len(speeds) and speeds[place] > 0.0:
        return {"standstill": _STANDSTILL * speeds[place]}
    return {}


def attach(
    twin: Twin,
    effects: Sequence[type[Effect]],
    kept: Callable[[type[Effect], str], bool],
    options: Callable[[type[Effect], int], dict[str, float]],
) -> tuple[Twin, list[Candidate]]:
    """
    Attach every effect at every place where it is not already.

    :param kept: whether an effect is tried at a place
    :param options: of an effect at the place of this index
    :return: the extended twin, and the candidates
    """
    there = {a.key for a in attached_of(twin)}
    wanted: list[Effect] = []
    places = {"joint": twin.joints, "actuator": twin.actuators, "channel": twin.channels}
    for kind in effects:
        if issubclass(kind, NeuralForce):
            raise EffectError(
                "NeuralForce is never the name of a cause. Leave it out: what remains is "
                "reported by itself."
            )
        for i, place in enumerate(places[kind.slot]):
            if f"{kind.name}.{place.name}" not in there and kept(kind, place.name):
                wanted.append(kind(i, **options(kind, i)))
    extended = twin.extend(*wanted) if wanted else twin
    candidates = [
        Candidate(
            a.effect.name,
            a.effect.slot,
            places[a.effect.slot][a.index].name,
            a.index,
            tuple(f"{a.key}.{name}" for name in a.effect.parameters),
            a.effect.explanation,
            tuple(a.effect.equivalents.items()),
            tuple(f"{a.key}.{name}" for name in a.effect.ascending),
        )
        for a in attached_of(extended)
        if not isinstance(a.effect, NeuralForce)
    ]
    if SignFlip in effects:
        candidates += _reversed_joints(twin)
    return extended, candidates + _shared(twin, candidates)


def _shared(twin: Twin, candidates: Sequence[Candidate]) -> list[Candidate]:
    """Effects of a bus or a power supply behind all actuators: one size for all of them."""
    found = _of_encoders(twin, candidates)
    for name in _SHARED:
        own = [c for c in candidates if c.name == name and c.slot == "actuator"]
        if len(own) > 1 and len(own) == len(twin.actuators):
            found.append(own[0].moved_to("actuator", EVERY, -1))
    return found


def _of_encoders(twin: Twin, candidates: Sequence[Candidate]) -> list[Candidate]:
    """Errors of an encoder that act on its position and on the velocity derived from it."""
    found = []
    for j, encoder in encoders(twin).items():
        for name in _DERIVED:
            own = [c for c in candidates if c.name == name and c.slot == "channel"]
            if encoder.velocity is None or not {*encoder.channels} <= {c.index for c in own}:
                continue
            (first,) = (c for c in own if c.index == encoder.position)
            found.append(first.moved_to("joint", twin.joints[j].name, j))
    return found


def ties_of(
    twin: Twin, candidates: Sequence[Candidate], single: Sequence[Candidate]
) -> dict[str, tuple[str, ...]]:
    """:return: by the name of a shared value, the parameters that take it"""
    found = {}
    for shared in candidates:
        if shared.place == EVERY:
            slot, where = "actuator", {actuator.name for actuator in twin.actuators}
        elif shared.slot == "joint" and shared.name in _DERIVED:
            channels = encoders(twin)[shared.index].channels
            slot, where = "channel", {twin.channels[i].name for i in channels}
        else:
            continue
        own = [
            c.key for c in single if (c.name, c.slot) == (shared.name, slot) and c.place in where
        ]
        for short, name in shared.full_names.items():
            found[name] = tuple(f"{key}.{short}" for key in own)
    return found


def _reversed_joints(twin: Twin) -> list[Candidate]:
    """Joints whose direction may be wrong: several channels have the wrong sign together."""
    found = []
    for i, joint in enumerate(twin.joints):
        try:
            flips = reversed_joint(twin, i)
        except EffectError:
            continue
        if len(flips) > 1:
            names = tuple(f"{SignFlip.name}.{flip.where}.flipped" for flip in flips)
            found.append(Candidate(SignFlip.name, "joint", joint.name, i, names, _OF_DIRECTION))
    return found


def has_memory(effect: Effect, twin: Twin) -> bool:
    """:return: whether it remembers earlier states, commands or readings"""
    if isinstance(effect, SensorEffect):
        return bool(jax.tree.leaves(effect.memory(jnp.zeros(()), twin)))
    acts = isinstance(effect, ForceEffect | ActionEffect)
    return acts and bool(jax.tree.leaves(effect.memory(twin)))


def attached_of(twin: Twin) -> tuple:
    """:return: effects with their places; none of a twin that is not extended"""
    layer = extended_of(twin)
    return layer.attached if layer else ()


def extended_of(twin: Twin) -> ExtendedTwin | None:
    return next((layer for layer in layers_of(twin) if isinstance(layer, ExtendedTwin)), None)


def native_targets(twin: Twin, candidates: Sequence[Candidate]) -> dict[str, str]:
    """Full name of an effect's parameter -> the twin's own parameter that it adds to."""
    plant = plant_of(twin)
    return {
        f"{c.key}.{name}": target
        for c in candidates
        for name, target in plant.native_effects.get((c.name, c.index), {}).items()
    }
