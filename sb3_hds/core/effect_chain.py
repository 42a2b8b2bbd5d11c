"""The effects attached to a twin, in the form in which its ``step`` evaluates them."""

import dataclasses
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sb3_hds.core.effect import ActionEffect, Effect, ForceEffect, Moment
from sb3_hds.core.numerics.linear import solve_spd
from sb3_hds.core.types import Action, Force, MassMatrix, Memory, Params, Position, Scalar, Velocity


@dataclasses.dataclass(frozen=True)
class Attached:
    """
    An effect at its place in a twin.

    :param key: full name, ``"viscous_friction.hinge"``: prefix of its parameters, key of its memory
    :param effect: the effect
    :param index: index of the joint, actuator or channel
    """

    key: str
    effect: Effect
    index: int

    def own(self, params: Params) -> Params:
        """:return: the effect's own parameters and tensors, without prefix"""
        names = (*self.effect.parameters, *self.effect.tensors)
        return {name: params[f"{self.key}.{name}"] for name in names}


class Chosen(NamedTuple):
    """
    The force effects that are evaluated; the others count as null. The choice may change between
    calls of one compiled program, and only chosen effects cost run time. Forward-mode derivatives
    only.

    :param free: indices of the effects evaluated at every stage, chosen ones first, and the number
        of chosen ones
    :param held: the same for the held effects
    :param on: whether each effect is chosen, by key
    """

    free: tuple[Any, Any]
    held: tuple[Any, Any]
    on: Mapping[str, Any]

    @classmethod
    def of(cls, attached: tuple[Attached, ...], keys: Collection[str]) -> "Chosen":
        """
        :param attached: all simulated effects of the twin
        :param keys: of the effects to evaluate
        """
        forces = {a.key: a.effect for a in attached if isinstance(a.effect, ForceEffect)}
        on = {key: np.array(key in keys) for key in forces}

        def first(held: bool) -> tuple[np.ndarray, np.ndarray]:
            chosen = np.array([on[key] for key in forces if forces[key].held == held], bool)
            return np.argsort(~chosen, kind="stable"), np.asarray(chosen.sum())

        return cls(first(False), first(True), on)


class EffectChain:
    """
    The attached effects with their values, as ``Twin.step`` evaluates them at each sub-step.

    :param attached: the effects, in the order of the signal path; sensor effects are ignored
    :param params: all parameters of the extended twin
    :param chosen: the force effects to evaluate; None: all
    """

    def __init__(
        self, attached: tuple[Attached, ...], params: Params, chosen: Chosen | None = None
    ) -> None:
        self._actions = [
            (a, a.effect, a.own(params)) for a in attached if isinstance(a.effect, ActionEffect)
        ]
        self._forces = [
            (a, a.effect, a.own(params)) for a in attached if isinstance(a.effect, ForceEffect)
        ]
        self._chosen = chosen

    def __add__(self, other: "EffectChain") -> "EffectChain":
        """:return: the effects of both; commands pass those of ``other`` last"""
        both = EffectChain((), {}, self._chosen or other._chosen)
        both._actions = self._actions + other._actions
        both._forces = self._forces + other._forces
        return both

    @property
    def is_empty(self) -> bool:
        """:return: whether there is neither a force nor an action effect"""
        return not (self._actions or self._forces)

    @property
    def has_forces(self) -> bool:
        """:return: whether any effect acts in the equation of motion"""
        return bool(self._forces)

    def act(
        self, action: Action, memory: dict[str, Memory], h: float
    ) -> tuple[Action, dict[str, Memory]]:
        """:return: the command that reaches the plant for ``h`` seconds, and the memory after it"""
        for attached, effect, params in self._actions:
            command, after = effect.act(action[attached.index], memory[attached.key], h, params)
            action, memory = action.at[attached.index].set(command), memory | {attached.key: after}
        return action, memory

    def force(self, moment: Moment, memory: dict[str, Memory], held: bool = False) -> Force:
        """:return: the sum of the held force effects, or of the others, shape ``(dof,)``"""
        total = jnp.zeros_like(moment.v)
        forces = [
            partial(effect.force, moment, attached.index, memory[attached.key], params)
            for attached, effect, params in self._forces
            if effect.held == held
        ]
        if self._chosen is None:
            return sum((force() for force in forces), total)
        if not forces:
            return total
        order, n = map(jnp.asarray, self._chosen.held if held else self._chosen.free)
        add = lambda i, total: total + jax.lax.switch(order[i], forces)  # noqa: E731
        return jax.lax.fori_loop(0, n, add, total)

    def load(
        self,
        bias: Callable[[], Force],
        mass_matrix: Callable[[], MassMatrix],
    ) -> tuple[Force, MassMatrix]:
        """
        :return: both; a zero load and a mass matrix without derivative if no evaluated effect
            depends on them
        """

        def both() -> tuple[Force, MassMatrix]:
            return bias(), mass_matrix()

        def neither() -> tuple[Force, MassMatrix]:
            matrix = jax.lax.stop_gradient(mass_matrix())
            return jnp.zeros_like(matrix[0]), matrix

        using = [attached.key for attached, effect, _ in self._forces if effect.uses_load]
        if not using:
            return neither()
        if self._chosen is None:
            return both()
        any_is_on = jnp.any(jnp.stack([jnp.asarray(self._chosen.on[key]) for key in using]))
        return jax.lax.cond(any_is_on, both, neither)

    def held(
        self,
        moment: Callable[..., Moment],
        q: Position,
        v: Velocity,
        memory: dict[str, Memory],
        h: float,
        displace: Callable[[Position, Velocity], Position],
    ) -> tuple[Force, Moment]:
        """
        :param moment: the system at a position and a velocity; ``with_load`` computes its load even
            if no effect uses it
        :param q: at the start of the sub-step
        :param v: at the start of the sub-step
        :param displace: moves a position by a velocity times a time
        :return: the sum of the held force effects, ``(dof,)``, and the system in the middle of the
            sub-step, where they are evaluated: it is reached with their values at the start
        """
        zero = jnp.zeros_like(v)
        if not any(effect.held for _, effect, _ in self._forces):
            return zero, moment(q, v)

        def evaluate(now: tuple[Force, Velocity], ahead: Scalar) -> tuple[Any, Any]:
            q_ahead, v_ahead = displace(q, ahead * v), v + ahead * now[1]
            there = moment(q_ahead, v_ahead, with_load=True)
            force = self.force(there, memory, held=True)
            total = there.actuator + force - there.load
            return (force, solve_spd(there.mass_matrix, total)), (q_ahead, v_ahead)

        def middle() -> tuple[Force, Position, Velocity]:
            ahead = jnp.array([0.0, 0.5], v.dtype) * h
            # One loop: unrolled, it takes twice as long to compile.
            (force, _), (qs, vs) = jax.lax.scan(evaluate, (zero, zero), ahead)
            return force, qs[-1], vs[-1]

        if self._chosen is None:
            force, *at = middle()
        else:
            force, *at = jax.lax.cond(self._chosen.held[1] > 0, middle, lambda: (zero, q, v))
        return force, moment(*at)

    def advance(self, middle: Moment, end: Moment, memory: dict[str, Memory]) -> dict[str, Memory]:
        """:return: the memory of the force effects after a sub-step with this middle and end"""
        for attached, effect, params in self._forces:
            moment, before = middle if effect.held else end, memory[attached.key]
            advanced = partial(effect.advance, moment, attached.index, before, params)
            if self._chosen is None:
                after = advanced()
            elif jax.tree.leaves(before):
                on, stay = self._chosen.on[attached.key], lambda before=before: before
                after = jax.lax.cond(on, advanced, stay)
            else:
                after = before
            memory = memory | {attached.key: after}
        return memory


NO_EFFECTS = EffectChain((), {})
