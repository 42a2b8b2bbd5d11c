"""A learned residual force."""

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Self

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from sb3_hds.core import ForceEffect, Moment, Parameter
from sb3_hds.core.trajectories.storage import read_npz, write_npz
from sb3_hds.core.twin import layers_of
from sb3_hds.core.types import Action, Coordinates, Force, Memory, Params, Scalar, Velocity
from sb3_hds.errors import EffectError, TrajectoryError

if TYPE_CHECKING:
    from sb3_hds.core import Twin

_FORMAT = "sb3_hds.NeuralForce"
# Largest force of a member, in units of the normalised output.
_MAX_OUTPUT = 3.0


class NeuralForce(ForceEffect):
    r"""
    A generalised force on all joints, learned from data: the mean of an ensemble of small networks.

    .. math::
        \tau = s\,\frac{1}{n} \sum_i \sigma_\tau\, 3 \tanh\!\Big(\tfrac{1}{3}
            f_i\big((z - \mu) / \sigma\big)\Big),
        \qquad z = (q, \cos q, \sin q, v, \tau_\text{act})

    Angles enter by cosine and sine, sliders as they are. Inputs and output are normalised by
    :math:`\mu, \sigma, \sigma_\tau`, which belong to the weights. The output is bounded, so it
    cannot diverge outside the data. It is evaluated once per sub-step and held: at every stage of
    the integrator, networks would dominate the cost of planning.

    A diagnosis never names it as a cause. It measures the residual of the named causes, and lets a
    policy be learned in spite of it.

    Source: Chua et al., *Deep reinforcement learning in a handful of trials*, NeurIPS 2018
    (ensembles); Heiden et al., *NeuralSim*, ICRA 2021 (residual forces inside a simulation).

    :param where: the joint that it is named after; it acts on all joints
    :param n_members: networks in the ensemble
    :param net_arch: units of the hidden layers
    :param caution: penalty in planning per unit of disagreement
    :param values: ``share``, the factor :math:`s`: 0 for no force, 1 for the learned one
    :raises EffectError: for an unknown parameter, or sizes that are not positive
    """

    name = "neural_force"
    held = True
    uses_load = False
    options = ("n_members", "net_arch", "caution")
    parameters = {"share": Parameter(null=0.0, scale=1.0, unit="1", lower=0.0, upper=1.0)}
    explanation = "Something acts on the joints that has no name here, and was learned from data."
    source = "Chua et al. 2018; Heiden et al. 2021"

    def __init__(
        self,
        where: int | str = 0,
        *,
        n_members: int = 5,
        net_arch: Sequence[int] = (8, 8),
        caution: float = 0.0,
        **values: float,
    ) -> None:
        super().__init__(where, **values)
        if n_members < 1 or not all(width >= 1 for width in net_arch):
            raise EffectError(
                f"An ensemble needs at least one member, and layers at least one unit, got "
                f"{n_members} of {tuple(net_arch)}."
            )
        self.n_members, self.net_arch = int(n_members), tuple(int(width) for width in net_arch)
        self.caution = float(caution)
        self.hinges: tuple[bool, ...] = ()

    def fitted_to(self, twin: "Twin") -> "NeuralForce":
        """:return: the effect for the joints of ``twin``; with random weights if it has none"""
        hinges = tuple(joint.unit == "rad" for joint in twin.joints)
        if self.tensors and hinges != self.hinges:
            raise EffectError(
                f"This NeuralForce was learned for {len(self.hinges)} joint(s), other than those "
                f"of {twin.name}. Learn it again: sysid.fit_residual."
            )
        if self.tensors:
            return self
        fitted = self.with_values()
        fitted.hinges = hinges
        return fitted.with_tensors(**fitted.fresh(jax.random.key(0)))

    def fresh(self, key: Array) -> dict[str, Any]:
        """:return: random weights, with means of zero and scales of one"""
        # Positions (two numbers for an angle), velocities and actuator forces.
        n_out = len(self.hinges)
        n_in = 3 * n_out + sum(self.hinges)
        draw = lambda k: self._network.init(k, jnp.zeros(n_in))["params"]  # noqa: E731
        return {
            "weights": jax.vmap(draw)(jax.random.split(key, self.n_members)),
            "input_mean": jnp.zeros(n_in),
            "input_scale": jnp.ones(n_in),
            "output_scale": jnp.ones(n_out),
        }

    def inputs(self, q: Coordinates, v: Velocity, actuator: Force) -> Float[Array, " inputs"]:
        """:return: the inputs of the networks before normalisation"""
        hinges = np.array(self.hinges, bool)
        angles = q[hinges]
        return jnp.concatenate([q[~hinges], jnp.cos(angles), jnp.sin(angles), v, actuator])

    def forces(
        self, q: Coordinates, v: Velocity, actuator: Force, own: Params
    ) -> Float[Array, "members dof"]:
        """:return: the force of each member for a share of one [N m] or [N]"""
        x = (self.inputs(q, v, actuator) - own["input_mean"]) / own["input_scale"]
        apply = lambda weights: jnp.asarray(self._network.apply({"params": weights}, x))  # noqa: E731
        outputs = jax.vmap(apply)(own["weights"])
        return own["output_scale"] * _MAX_OUTPUT * jnp.tanh(outputs / _MAX_OUTPUT)

    def force_at(self, q: Coordinates, v: Velocity, actuator: Force, own: Params) -> Force:
        """:return: the mean of the ensemble times the share [N m] or [N]"""
        return own["share"] * jnp.mean(self.forces(q, v, actuator, own), 0)

    def force(self, moment: Moment, index: int, memory: Memory, params: Params) -> Force:
        return self.force_at(moment.q, moment.v, moment.actuator, params)

    def disagreement(self, q: Coordinates, v: Velocity, actuator: Force, own: Params) -> Scalar:
        """
        :return: standard deviation of the members in units of the normalised output, the largest
            over the joints
        """
        std = jnp.std(self.forces(q, v, actuator, own), 0)
        return jnp.max(std / own["output_scale"])

    def uncertainty_penalty(
        self, twin: "Twin", state: Any, action: Action, base: Params, own: Params
    ) -> Scalar:
        if not self.caution:
            return jnp.zeros(())
        actuator = twin.actuate(state, action, base)  # type: ignore[attr-defined]
        q = twin.coordinates(state.q)
        return self.caution * own["share"] * self.disagreement(q, state.v, actuator, own)

    def structure(self) -> tuple[Any, ...]:
        return (*super().structure(), self.hinges)

    def save(self, path: str | os.PathLike[str]) -> Any:
        """
        Write one ``.npz`` file, without pickle; a file of that name is replaced.

        :return: the path of the file
        :raises EffectError: before it was attached to a twin
        """
        if not self.tensors:
            raise EffectError("There is nothing to save: attach it to a twin first.")
        flat, _ = ravel_pytree(self.tensors)
        return write_npz(
            path,
            {
                "format": np.array(_FORMAT),
                "where": np.array(self.where),
                "n_members": np.array(self.n_members),
                "net_arch": np.array(self.net_arch, int),
                "caution": np.array(self.caution),
                "hinges": np.array(self.hinges, bool),
                "share": np.array(self.values["share"]),
                "tensors": np.asarray(flat),
            },
        )

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """
        :param path: as given to :meth:`save`
        :raises EffectError: if the file is missing, damaged, or of another kind
        """
        try:
            stored = read_npz(path)
            if stored.get("format", np.array("")).tolist() != _FORMAT:
                raise ValueError(f"it holds: {', '.join(stored)}")
            loaded = cls(
                stored["where"].tolist(),
                n_members=int(stored["n_members"]),
                net_arch=stored["net_arch"].tolist(),
                caution=float(stored["caution"]),
                share=float(stored["share"]),
            )
            loaded.hinges = tuple(stored["hinges"].tolist())
            flat, unravel = ravel_pytree(loaded.fresh(jax.random.key(0)))
            if stored["tensors"].shape != flat.shape or not np.isfinite(stored["tensors"]).all():
                raise ValueError("its weights do not fit its sizes, or are not finite")
            return loaded.with_tensors(**unravel(jnp.asarray(stored["tensors"], flat.dtype)))
        except (TrajectoryError, KeyError, ValueError, TypeError) as error:
            raise EffectError(f"'{path}' was not written by NeuralForce.save ({error}).") from error

    @property
    def _network(self) -> "_Member":
        return _Member(self.net_arch, len(self.hinges))


class _Member(nn.Module):
    """One network of the ensemble."""

    net_arch: tuple[int, ...]
    n_out: int

    @nn.compact
    def __call__(self, x: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
        for width in self.net_arch:
            x = jnp.tanh(nn.Dense(width)(x))
        return nn.Dense(self.n_out)(x)


def force_of(twin: "Twin") -> tuple[str, NeuralForce] | None:
    """:return: full name and effect of a twin's learned force; None without one"""
    for layer in layers_of(twin):
        for a in getattr(layer, "attached", ()):
            if isinstance(a.effect, NeuralForce):
                return a.key, a.effect
    return None
