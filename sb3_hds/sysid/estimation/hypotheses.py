"""All hypotheses in one model: every candidate is attached, and its parameters switch it on."""

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from functools import cached_property, partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from sb3_hds.core import ActionEffect, Effect, ForceEffect, Parameter, Params, Twin
from sb3_hds.core.effect_chain import Attached, Chosen
from sb3_hds.core.extended import with_native
from sb3_hds.effects import NAMELESS, ConstantForce
from sb3_hds.errors import CalibrationError
from sb3_hds.sysid.estimation.candidates import (
    PARAMETER,
    Candidate,
    attach,
    attached_of,
    extended_of,
    has_memory,
    native_targets,
    options_for,
    single_keys,
    ties_of,
)
from sb3_hds.sysid.estimation.parameters import Belief, Free, prior_of
from sb3_hds.sysid.estimation.shooting import remembered_for, remembers_for

_OF_PARAMETER = "The twin's {} is not that of the system."


@dataclasses.dataclass(frozen=True, eq=False)
class Hypotheses:
    """
    A twin with every candidate attached, all at the values at which they have no effect.

    :param nominal: model without any cause
    :param twin: extended by all effects
    :param candidates: causes that may be named
    :param names: all parameters that may be fitted, nuisances first
    :param null: their values under the nominal model, shape ``(p,)``
    :param scale: their typical deviations from it
    :param lower: smallest admissible values
    :param upper: largest admissible values
    :param nuisances: indices of those that are refitted under every hypothesis
    :param prior: standard deviation of the prior of each nuisance around its value in ``null``;
        infinite for all other parameters
    :param pushes: index of a constant force at each joint, to measure the residual force
    :param nameless: flexible forces: never a finding, but findings have to beat them
    :param ties: parameters that share one value, by the name of that value
    :param period: of the motion [s]
    :param starts: for candidates by key, values by full name at which a search may begin
    """

    nominal: Twin
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
        :param twin: nominal model
        :param effects: classes that are tried at every place
        :param only: keys of the candidates that are kept; default: all
        :param nameless_at: joints at which flexible forces are tried; default: all
        :param period: of the motion [s]: delays are at most 0.3 of it
        :param speeds: root mean square velocity of each joint, in which dry friction is smoothed;
            default: as the effects have it
        :param calibrate: nuisance parameters, which are no findings; see
            :func:`~sb3_hds.sysid.estimation.parameters.prior_of`
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
        pushed = () if ConstantForce in effects else (ConstantForce,)
        rivals = tuple(kind for kind in NAMELESS if kind not in effects)
        wanted = None if only is None else single_keys(only, twin)

        def kept(kind: type[Effect], place: str) -> bool:
            if kind in rivals:
                return nameless_at is None or place in nameless_at
            # Constant forces serve to measure the residual force.
            return wanted is None or kind is ConstantForce or f"{kind.name}.{place}" in wanted

        options = partial(options_for, period, speeds)
        extended, found = attach(twin, (*effects, *pushed, *rivals), kept, options)
        nameless = tuple(c for c in found if c.name in {kind.name for kind in rivals})
        found = [c for c in found if c not in nameless]
        pushes = tuple(f"{ConstantForce.name}.{joint.name}.tau_0" for joint in twin.joints)
        if pushed:
            found = [c for c in found if c.parameters[0] not in pushes]
        native = native_targets(twin, found)
        there = {name for c in found for name in c.parameters}
        candidates = [
            Candidate(f"parameter.{name}", PARAMETER, name, i, (name,), _OF_PARAMETER.format(name))
            for i, name in enumerate(n for n in twin.parameters if not n.endswith(".share"))
            if name not in {*calibrate, *native.values(), *there, *twin.known_parameters}
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
        ties = ties_of(twin, candidates, found)
        every = {name: extended.parameters[ties.get(name, (name,))[0]] for name in moving}
        values = np.array([extended.values[ties.get(name, (name,))[0]] for name in moving], float)
        lower = np.array([every[name].lower for name in moving], float)
        for i, name in enumerate(moving):
            if name in native and every[name].null == 0.0:
                # The twin has some of it already, and the truth may be less.
                lower[i] = twin.parameters[native[name]].lower - twin.values[native[name]]
        upper = np.array([every[name].upper for name in moving], float)
        prior = np.full(len(moving), np.inf)
        for i, (name, belief) in enumerate(beliefs.items()):
            own = twin.parameters[name], twin.values[name]
            prior[i], lower[i], upper[i] = prior_of(name, *own, belief)
        return cls(
            nominal=twin,
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
        prior_mean: Float[np.ndarray, " p"] | None = None,
        prior: float = 0.0,
    ) -> "Hypotheses":
        """
        No candidates: only parameters to estimate.

        :param twin: as it is
        :param free: parameters, by the name of the value that they take
        :param prior_mean: centre of the prior; default: the twin's own values
        :param prior: how firm it is, as the reciprocal of its standard deviation in units of each
            parameter's scale; 0: there is none
        """
        first = [members[0] for members in free.values()]
        own = [twin.parameters[name] for name in first]
        scale = np.array([p.scale for p in own], float)
        values = np.array([twin.values[name] for name in first], float)
        return cls(
            nominal=twin,
            twin=twin,
            candidates=(),
            names=tuple(free),
            null=values if prior_mean is None else np.asarray(prior_mean, float),
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
    def memory_length(self) -> Float[np.ndarray, " p"]:
        """:return: after how long the memory that each parameter shapes is forgotten [s]"""
        found = {
            f"{a.key}.{name}": remembers_for(a.effect, self.period)
            for a in attached_of(self.twin)
            if has_memory(a.effect, self.twin)
            for name in a.effect.parameters
        }
        return np.array([found.get(self._single(name), 0.0) for name in self.names])

    def parameter(self, name: str) -> Parameter:
        """:return: unit, scale and bounds of a parameter, or of a value that several share"""
        return self.twin.parameters[self._single(name)]

    def _single(self, name: str) -> str:
        return self.ties[name][0] if name in self.ties else name

    def chosen(self, theta: Float[np.ndarray, " p"], index: Int[np.ndarray, " k"]) -> Chosen | None:
        """
        :param theta: all parameters, shape ``(p,)``
        :param index: of those by which slopes are taken; indices beyond them are padding
        :return: the effects that are not null, or whose slopes are taken; None for all, where there
            is no candidate
        """
        if not self.candidates:
            return None
        layer, moving = extended_of(self.twin), {self.names[i] for i in index if i < len(theta)}
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
        """:return: after how long the memory of the nominal model is forgotten [s]"""
        return remembered_for(self.nominal, self.period)

    def effect_of(self, candidate: Candidate) -> Effect | None:
        """:return: the effect that the candidate is; None for a parameter, or several effects"""
        shared = bool({*candidate.parameters} & {*self.ties})
        found = (
            a.effect
            for a in attached_of(self.twin)
            if a.key == candidate.key or (shared and a.effect.name == candidate.name)
        )
        return next(found, None)

    def remembers(self, candidate: Candidate) -> bool:
        """:return: whether it has memory of earlier states or commands"""
        effect = self.effect_of(candidate)
        return isinstance(effect, ForceEffect | ActionEffect) and has_memory(effect, self.twin)

    def related(self, candidate: Candidate) -> list[Candidate]:
        """:return: candidates that are declared indistinguishable from one, at its place"""
        return [other for other in self.candidates if candidate.resembles(other)]

    def alike(self, key: str, other: str) -> str:
        """:return: when two candidates are indistinguishable, as declared; empty otherwise"""
        known = {c.key: c for c in self.candidates}
        if not {key, other} <= known.keys():
            return ""
        return known[key].resembles(known[other]) or known[other].resembles(known[key])

    def indices(self, candidate: Candidate) -> tuple[int, ...]:
        return tuple(self.names.index(name) for name in candidate.parameters)

    def added_to(self, name: str) -> float:
        """:return: what the nominal model already has of an effect's parameter"""
        target = native_targets(self.nominal, self.candidates).get(name)
        if target is None or self.twin.parameters[name].null != 0.0:
            return 0.0
        return self.nominal.values[target]

    def scaled(self, scales: Mapping[str, float]) -> "Hypotheses":
        """:return: the same with these typical deviations, by full name"""
        scale = [scales.get(n, s) for n, s in zip(self.names, self.scale, strict=True)]
        return dataclasses.replace(self, scale=np.array(scale))

    def extended_by(self, causes: Sequence[str], theta: Float[np.ndarray, " p"]) -> Twin:
        """
        :param causes: names and places of candidates
        :param theta: all parameters, shape ``(p,)``
        :return: the nominal model, with the nuisances refitted and these causes in it
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
        native = native_targets(self.nominal, chosen)
        for name in names:
            if name in native:
                own[native[name]] = with_native(
                    self.nominal.values[native[name]], value[name], self.twin.parameters[name]
                )
            elif name in self.nominal.parameters:
                own[name] = value[name]
        there = {a.key for a in attached_of(self.nominal)}
        wanted = {name.rpartition(".")[0] for name in singles}
        new = [
            a.effect.with_values(**{n: value[f"{a.key}.{n}"] for n in a.effect.parameters})
            for a in attached_of(self.twin)
            if a.key in wanted
            and a.key not in there
            and not any(f"{a.key}.{n}" in native for n in a.effect.parameters)
        ]
        twin = self.nominal.with_parameters(**own) if own else self.nominal
        return twin.extend(*new) if new else twin

    def place_of(self, candidate: Candidate) -> dict[str, str | int]:
        """:return: where it is, as plain data"""
        return {"slot": candidate.slot, "index": candidate.index, "name": candidate.place}
