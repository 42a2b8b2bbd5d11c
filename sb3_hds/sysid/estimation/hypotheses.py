"""What may be wrong with a twin: all candidates at once, each switched by its parameters."""

import dataclasses
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cached_property, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from sb3_hds.core import (
    ActionEffect,
    Effect,
    ExtendedTwin,
    ForceEffect,
    Parameter,
    Params,
    SensorEffect,
    Twin,
)
from sb3_hds.core.effect_chain import Attached, Chosen
from sb3_hds.core.extended import with_native
from sb3_hds.core.twin import layers_of, plant_of
from sb3_hds.effects import (
    NAMELESS,
    ActionDelay,
    ConstantForce,
    DryFriction,
    NeuralForce,
    SensorDelay,
    SignFlip,
    reversed_joint,
)
from sb3_hds.errors import CalibrationError, EffectError
from sb3_hds.sysid.estimation.free import Free
from sb3_hds.sysid.estimation.priors import Belief, prior_of
from sb3_hds.sysid.estimation.shooting import remembered_for, remembers_for

# Longest delay, in periods of the motion, and the speed below which dry friction is smoothed, in
# root mean square ones.
_LATEST, _STANDSTILL = 0.3, 0.01
#: the slot of a twin's own parameter, beside those of effects
PARAMETER = "parameter"


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
    :param equivalents: names of effects that data may not tell from this one, and when
    :param ascending: those of the parameters that may not fall from one to the next
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

    def resembles(self, other: "Candidate") -> str:
        """:return: when it looks like another one, as it declares; nothing at another place"""
        elsewhere = other.slot == self.slot and other.index != self.index
        return "" if elsewhere else dict(self.equivalents).get(other.name, "")


@dataclasses.dataclass(frozen=True, eq=False)
class Hypotheses:
    """
    A twin with every candidate attached, all at the value at which they change nothing.

    :param believed: the twin as it came
    :param twin: extended by all effects
    :param candidates: what may be named
    :param names: all parameters that may move, nuisances first
    :param null: their values when nothing is wrong, shape ``(p,)``
    :param scale: their typical deviations
    :param lower: smallest admissible values
    :param upper: largest admissible values
    :param nuisances: indices of those that are refitted under every hypothesis
    :param prior: standard deviation of the prior of each nuisance around its value in ``null``;
        infinite for all other parameters
    :param pushes: index of a constant force at each joint, to measure what force is missing
    :param nameless: forces that no finding is, and that findings have to beat
    :param ties: parameters of which one number is shared, by the name of that number
    :param period: of the motion [s]
    :param starts: for candidates by key, values by full name at which a search may begin
    """

    believed: Twin
    twin: Twin
    candidates: tuple[Candidate, ...]
    names: tuple[str, ...]
    null: Float[np.ndarray, " p"]
    scale: Float[np.ndarray, " p"]
    lower: Float[np.ndarray, " p"]
    upper: Float[np.ndarray, " p"]
    nuisances: tuple[int, ...]
    prior: Float[np.ndarray, " p"]
    pushes: tuple[int, ...]
    nameless: tuple[Candidate, ...] = ()
    ties: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)
    period: float = 1.0
    starts: Mapping[str, tuple[Mapping[str, float], ...]] = dataclasses.field(default_factory=dict)

    @classmethod
    def about(
        cls,
        twin: Twin,
        effects: Sequence[type[Effect]],
        calibrate: Sequence[str] | Mapping[str, Belief],
        only: Collection[str] | None = None,
        nameless_at: Collection[str] | None = None,
        period: float = 1.0,
        speeds: Sequence[float] = (),
    ) -> "Hypotheses":
        """
        :param twin: as it is believed
        :param effects: classes that are tried at every place
        :param only: keys of the candidates that are kept; default: all
        :param nameless_at: joints at which forces without a name are tried; default: all
        :param period: of the motion [s]: what is later than a third of it is no delay
        :param speeds: root mean square velocity of each joint, in which dry friction is smoothed;
            default: as the effects have it
        :param calibrate: parameters of the twin that are not believed, and not worth a finding; see
            :func:`~sb3_hds.sysid.estimation.priors.prior_of`
        :raises CalibrationError: for a name in ``calibrate`` that the twin does not have, or a
            belief that is none
        """
        beliefs = dict(calibrate) if isinstance(calibrate, Mapping) else dict.fromkeys(calibrate)
        calibrate = tuple(beliefs)
        unknown = [name for name in calibrate if name not in twin.parameters]
        if unknown:
            raise CalibrationError(
                f"calibrate names {', '.join(unknown)}, which {twin.name} does not have. "
                f"Its parameters are: {', '.join(twin.parameters) or 'none'}."
            )
        own = tuple(name for name in twin.parameters if not name.endswith(".share"))
        known = twin.known_parameters
        pushed = () if ConstantForce in effects else (ConstantForce,)
        rivals = tuple(kind for kind in NAMELESS if kind not in effects)
        wanted = None if only is None else _single(only, twin)
        kept = lambda kind, place: (  # noqa: E731
            (nameless_at is None or place in nameless_at)
            if kind in rivals
            else wanted is None or kind in pushed or f"{kind.name}.{place}" in wanted
        )
        if wanted is not None and ConstantForce in effects:
            kept = _with_pushes(kept)
        options = partial(_options, period, speeds)
        extended, found = _attached(twin, (*effects, *pushed, *rivals), kept, options)
        nameless = tuple(c for c in found if c.name in {kind.name for kind in rivals})
        found = [c for c in found if c not in nameless]
        pushes = tuple(f"{ConstantForce.name}.{joint.name}.tau_0" for joint in twin.joints)
        if pushed:
            found = [c for c in found if c.parameters[0] not in pushes]
        native = _native_targets(twin, found)
        there = {name for c in found for name in c.parameters}
        candidates = [
            Candidate(f"parameter.{name}", PARAMETER, name, i, (name,), _OF_PARAMETER.format(name))
            for i, name in enumerate(own)
            if name not in {*calibrate, *native.values(), *there, *known}
        ]
        candidates += [
            c
            for c in found
            if native.get(c.parameters[0]) not in calibrate and not {*c.parameters} <= {*calibrate}
        ]
        if only is not None:
            candidates = [c for c in candidates if c.key in only]
        moving = (*calibrate, *dict.fromkeys(p for c in candidates for p in c.parameters))
        moving += tuple(name for name in pushes if name not in moving)
        moving += tuple(name for c in nameless for name in c.parameters)
        ties = _ties(twin, candidates, found)
        every = {name: extended.parameters[ties.get(name, (name,))[0]] for name in moving}
        values = np.array([extended.values[ties.get(name, (name,))[0]] for name in moving], float)
        lower = np.array([every[name].lower for name in moving], float)
        for i, name in enumerate(moving):
            if name in native:
                # The twin has some of it already: there may be less than it believes.
                target = native[name]
                if every[name].null == 0.0:
                    lower[i] = twin.parameters[target].lower - twin.values[target]
        upper = np.array([every[name].upper for name in moving], float)
        prior = np.full(len(moving), np.inf)
        for i, (name, belief) in enumerate(beliefs.items()):
            own_prior = prior_of(name, twin.parameters[name], twin.values[name], belief)
            prior[i], lower[i], upper[i] = own_prior
        return cls(
            believed=twin,
            twin=extended,
            candidates=tuple(candidates),
            names=moving,
            null=values,
            scale=np.array([every[name].scale for name in moving], float),
            lower=lower,
            upper=upper,
            nuisances=tuple(range(len(calibrate))),
            prior=prior,
            pushes=tuple(moving.index(name) for name in pushes),
            nameless=nameless,
            ties=ties,
            period=period,
        )

    @classmethod
    def of_values(
        cls,
        twin: Twin,
        free: Free,
        believed: Float[np.ndarray, " p"] | None = None,
        prior: float = 0.0,
    ) -> "Hypotheses":
        """
        No cause, but values of parameters that are not known.

        :param twin: as it is
        :param free: parameters, by the name of the value that they take
        :param believed: centre of the prior; default: the twin's own values
        :param prior: how firm it is, as the reciprocal of its standard deviation in units of each
            parameter's scale; 0: there is none
        """
        first = [members[0] for members in free.values()]
        own = [twin.parameters[name] for name in first]
        scale = np.array([p.scale for p in own], float)
        values = np.array([twin.values[name] for name in first], float)
        return cls(
            believed=twin,
            twin=twin,
            candidates=(),
            names=tuple(free),
            null=values if believed is None else np.asarray(believed, float),
            scale=scale,
            lower=np.array([p.lower for p in own], float),
            upper=np.array([p.upper for p in own], float),
            nuisances=tuple(range(len(own))),
            prior=scale / prior if prior else np.full(len(own), np.inf),
            pushes=(),
            ties={name: members for name, members in free.items() if members != (name,)},
        )

    @cached_property
    def fixed(self) -> Params:
        """All parameters of the extended twin, in double precision."""
        with jax.enable_x64(True):
            return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), self.twin.params)

    @cached_property
    def forgets(self) -> Float[np.ndarray, " p"]:
        """:return: after how long the memory that each parameter shapes is forgotten [s]"""
        found = {
            f"{a.key}.{name}": remembers_for(a.effect, self.period)
            for a in _attached_of(self.twin)
            if _remembers(a.effect, self.twin)
            for name in a.effect.parameters
        }
        return np.array([found.get(self._single(name), 0.0) for name in self.names])

    def parameter(self, name: str) -> Parameter:
        """:return: unit, scale and bounds of a parameter, or of a number that several share"""
        return self.twin.parameters[self._single(name)]

    def _single(self, name: str) -> str:
        return self.ties[name][0] if name in self.ties else name

    def chosen(self, theta: Float[np.ndarray, " p"], index: Int[np.ndarray, " k"]) -> Chosen | None:
        """
        :param theta: all parameters, shape ``(p,)``
        :param index: of those by which slopes are taken; others than parameters name nothing
        :return: the effects that are not null, or whose slopes are asked for; None for all, where
            there is no candidate
        """
        if not self.candidates:
            return None
        layer, moving = _extended_of(self.twin), {self.names[i] for i in index if i < len(theta)}
        if layer is None:
            return Chosen.of((), ())
        value = layer.values | dict(zip(self.names, theta, strict=True))

        def silent(a: Attached) -> bool:
            nulls = {f"{a.key}.{name}": p.null for name, p in a.effect.parameters.items()}
            still = all(value[name] == null for name, null in nulls.items())
            return still and not a.effect.tensors and moving.isdisjoint(nulls)

        return layer.choose([a.key for a in layer.attached if not silent(a)])

    @cached_property
    def always(self) -> float:
        """:return: the same for what the twin as it came remembers [s]"""
        return remembered_for(self.believed, self.period)

    def effect_of(self, candidate: Candidate) -> Effect | None:
        """:return: the effect that the candidate is; None for a parameter, or several effects"""
        shared = bool({*candidate.parameters} & {*self.ties})
        found = [
            a.effect
            for a in _attached_of(self.twin)
            if a.key == candidate.key or (shared and a.effect.name == candidate.name)
        ]
        return found[0] if found else None

    def remembers(self, candidate: Candidate) -> bool:
        """:return: whether it is a force or a command that depends on what was before"""
        effect = self.effect_of(candidate)
        return isinstance(effect, ForceEffect | ActionEffect) and _remembers(effect, self.twin)

    def related(self, candidate: Candidate) -> list[Candidate]:
        """:return: what is declared to look like a candidate, at its place"""
        return [other for other in self.candidates if candidate.resembles(other)]

    def alike(self, key: str, other: str) -> str:
        """:return: when two candidates look alike, as one of them declares, or nothing"""
        known = {c.key: c for c in self.candidates}
        if not {key, other} <= known.keys():
            return ""
        return known[key].resembles(known[other]) or known[other].resembles(known[key])

    def indices(self, candidate: Candidate) -> tuple[int, ...]:
        return tuple(self.names.index(name) for name in candidate.parameters)

    def added_to(self, name: str) -> float:
        """:return: what the twin as it came has already of an effect's parameter"""
        target = _native_targets(self.believed, self.candidates).get(name)
        if target is None or self.twin.parameters[name].null != 0.0:
            return 0.0
        return self.believed.values[target]

    def scaled(self, scales: Mapping[str, float]) -> "Hypotheses":
        """:return: the same with these typical deviations, by full name"""
        scale = [scales.get(n, s) for n, s in zip(self.names, self.scale, strict=True)]
        return dataclasses.replace(self, scale=np.array(scale))

    def extended_by(self, causes: Sequence[str], theta: Float[np.ndarray, " p"]) -> Twin:
        """
        :param causes: names and places of candidates
        :param theta: all parameters, shape ``(p,)``
        :return: the twin as it came, with the nuisances refitted and these causes in it
        """
        value = dict(zip(self.names, map(float, theta), strict=True))
        chosen = [c for c in self.candidates if c.key in causes]
        names = [name for c in chosen for name in c.parameters]
        for tie in (name for name in names if name in self.ties):
            for single in self.ties[tie]:
                null = self.parameter(single).null
                value[single] = value.get(single, null) + value[tie] - null
        singles = [single for name in names for single in self.ties.get(name, (name,))]
        own = {self.names[i]: value[self.names[i]] for i in self.nuisances}
        native = _native_targets(self.believed, chosen)
        for name in (name for c in chosen for name in c.parameters):
            if name in native:
                own[native[name]] = with_native(
                    self.believed.values[native[name]], value[name], self.twin.parameters[name]
                )
            elif name in self.believed.parameters:
                own[name] = value[name]
        there = {a.key for a in _attached_of(self.believed)}
        wanted = {name.rpartition(".")[0] for name in singles}
        new = [
            a.effect.with_values(**{n: value[f"{a.key}.{n}"] for n in a.effect.parameters})
            for a in _attached_of(self.twin)
            if a.key in wanted
            and a.key not in there
            and not any(f"{a.key}.{n}" in native for n in a.effect.parameters)
        ]
        twin = self.believed.with_parameters(**own) if own else self.believed
        return twin.extend(*new) if new else twin

    def place_of(self, candidate: Candidate) -> dict[str, str | int]:
        """:return: where it is, as plain data"""
        return {"slot": candidate.slot, "index": candidate.index, "name": candidate.place}


#: where something acts that all actuators share
EVERY = "all"
# What they may share: a bus, a controller.
_SHARED = ("action_delay", "motor_lag")
# What a velocity takes over from the position that it is derived from.
_DERIVED = ("sensor_scale", "sensor_delay")
_OF_PARAMETER = "The twin's {} is not that of the system."
_OF_DIRECTION = "The direction of the joint is taken the wrong way round, in position and velocity."


def _single(keys: Collection[str], twin: Twin) -> set[str]:
    """:return: keys of what is attached: of a cause at several places, what is at each"""
    found = set(keys)
    for key in keys:
        name, _, place = key.partition(".")
        if place == EVERY:
            found |= {f"{name}.{actuator.name}" for actuator in twin.actuators}
        if name in (SignFlip.name, *_DERIVED):
            found |= {f"{name}.{channel.name}" for channel in twin.channels}
    return found


def _with_pushes(kept: Callable[[type[Effect], str], bool]) -> Callable[[type[Effect], str], bool]:
    """Constant forces serve to measure what force is missing."""
    return lambda kind, place: kind is ConstantForce or kept(kind, place)


def _options(
    period: float, speeds: Sequence[float], kind: type[Effect], place: int
) -> dict[str, float]:
    """Scales of the motion in the place of seconds and radians that suit most machines."""
    if issubclass(kind, ActionDelay | SensorDelay):
        return {"longest": _LATEST * period}
    if issubclass(kind, DryFriction) and len(speeds) and speeds[place] > 0.0:
        return {"standstill": _STANDSTILL * speeds[place]}
    return {}


def _attached(
    twin: Twin,
    effects: Sequence[type[Effect]],
    kept: Callable[[type[Effect], str], bool],
    options: Callable[[type[Effect], int], dict[str, float]],
) -> tuple[Twin, list[Candidate]]:
    """Every effect that is wanted at every place where it is not already."""
    there = {a.key for a in _attached_of(twin)}
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
    candidates = []
    for a in _attached_of(extended):
        if isinstance(a.effect, NeuralForce):
            continue
        candidates.append(
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
        )
    if SignFlip in effects:
        candidates += _reversed_joints(twin)
    return extended, candidates + _shared(twin, candidates)


def _shared(twin: Twin, candidates: Sequence[Candidate]) -> list[Candidate]:
    """One bus or one power supply behind all actuators: one size for all of them."""
    found = _of_encoders(twin, candidates)
    for name in _SHARED:
        own = [c for c in candidates if c.name == name and c.slot == "actuator"]
        if len(own) > 1 and len(own) == len(twin.actuators):
            tie = f"{name}.{EVERY}"
            names = tuple(f"{tie}.{p.rpartition('.')[2]}" for p in own[0].parameters)
            found.append(dataclasses.replace(own[0], place=EVERY, index=-1, parameters=names))
    return found


def _of_encoders(twin: Twin, candidates: Sequence[Candidate]) -> list[Candidate]:
    """What is wrong with a sensor is wrong with the velocity, too, that is derived from it."""
    found = []
    for j, encoder in encoders(twin).items():
        for name in _DERIVED:
            own = [c for c in candidates if c.name == name and c.slot == "channel"]
            if encoder.velocity is None or not {*encoder.channels} <= {c.index for c in own}:
                continue
            (first,) = (c for c in own if c.index == encoder.position)
            place = twin.joints[j].name
            names = tuple(f"{name}.{place}.{p.rpartition('.')[2]}" for p in first.parameters)
            found.append(
                dataclasses.replace(first, slot="joint", place=place, index=j, parameters=names)
            )
    return found


class Encoder(NamedTuple):
    """
    :param position: index of the channel that reports a joint's position
    :param velocity: of the one that reports its velocity; None if there is none
    """

    position: int
    velocity: int | None

    @property
    def channels(self) -> tuple[int, ...]:
        """Indices of all channels that it feeds."""
        return (self.position,) if self.velocity is None else (self.position, self.velocity)


def encoders(twin: Twin) -> dict[int, Encoder]:
    """:return: by joint, where channels are positions and velocities themselves"""
    twin = plant_of(twin)
    dof = len(twin.joints)
    state = twin.initial(jax.random.key(0), twin.params)
    if state.q.shape != (dof,):
        return {}

    def seen(x: jax.Array) -> jax.Array:
        return twin.observe(state._replace(q=x[:dof], v=x[dof:]), twin.params)

    here = jnp.concatenate([0.3 + 0.1 * jnp.arange(dof), 0.7 - 0.1 * jnp.arange(dof)])
    slopes, values = np.asarray(jax.jacfwd(seen)(here)), np.asarray(seen(here))
    unit = np.abs(np.abs(slopes).sum(1) - 1.0) < 1e-6
    found = {}
    for j in range(dof):
        places = [
            [
                i
                for i in np.flatnonzero(unit)
                if np.isclose(slopes[i, k], 1.0) and np.isclose(values[i], here[k], atol=1e-5)
            ]
            for k in (j, dof + j)
        ]
        if len(places[0]) == 1 and len(places[1]) <= 1:
            velocity = int(places[1][0]) if places[1] else None
            found[j] = Encoder(int(places[0][0]), velocity)
    return found


def _ties(
    twin: Twin, candidates: Sequence[Candidate], single: Sequence[Candidate]
) -> dict[str, tuple[str, ...]]:
    """:return: by the name of a shared number, the parameters that take it"""
    found = {}
    for shared in candidates:
        if shared.place == EVERY:
            own = [c for c in single if c.name == shared.name and c.slot == "actuator"]
            own = [c for c in own if c.place != EVERY]
        elif shared.slot == "joint" and shared.name in _DERIVED:
            channels = encoders(twin)[shared.index].channels
            own = [c for c in single if c.name == shared.name and c.slot == "channel"]
            own = [c for c in own if c.index in channels]
        else:
            continue
        for name in shared.parameters:
            short = name.rpartition(".")[2]
            found[name] = tuple(f"{c.key}.{short}" for c in own)
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


def _remembers(effect: Effect, twin: Twin) -> bool:
    if isinstance(effect, SensorEffect):
        return bool(jax.tree.leaves(effect.memory(jnp.zeros(()), twin)))
    return isinstance(effect, ForceEffect | ActionEffect) and bool(
        jax.tree.leaves(effect.memory(twin))
    )


def _attached_of(twin: Twin) -> tuple:
    layer = _extended_of(twin)
    return layer.attached if layer else ()


def _extended_of(twin: Twin) -> ExtendedTwin | None:
    return next((layer for layer in layers_of(twin) if isinstance(layer, ExtendedTwin)), None)


def _native_targets(twin: Twin, candidates: Sequence[Candidate]) -> dict[str, str]:
    """Full name of an effect's parameter -> the twin's own parameter that it adds to."""
    plant = plant_of(twin)
    return {
        f"{c.key}.{name}": target
        for c in candidates
        for name, target in plant.native_effects.get((c.name, c.index), {}).items()
    }
