"""Aliases for annotated arrays. The tests check shapes at every call."""

from typing import Any, TypeAlias

from jaxtyping import Array, Bool, Float

Position: TypeAlias = Float[Array, " position"]  # [rad], [m], quaternions; else one for each dof
Coordinates: TypeAlias = Float[Array, " dof"]  # position of each joint, [rad] or [m]
Velocity: TypeAlias = Float[Array, " dof"]  # [rad/s] or [m/s]
Force: TypeAlias = Float[Array, " dof"]  # generalised force, [N m] or [N]
MassMatrix: TypeAlias = Float[Array, "dof dof"]
Action: TypeAlias = Float[Array, " act"]  # in the units of the action space
Obs: TypeAlias = Float[Array, " obs"]
Tangent: TypeAlias = Float[Array, " tangent"]  # a small change of a state
Scalar: TypeAlias = Float[Array, ""]
Flag: TypeAlias = Bool[Array, ""]
Memory: TypeAlias = Any  # of an effect, from one sub-step to the next: a pytree of float arrays
Params: TypeAlias = dict[str, Any]  # by full parameter name: a float or a scalar array
