"""Structural identifiability of the inertial parameters of a mechanism."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from sb3_hds.errors import first_names
from sb3_hds.twins.mujoco.parameters import (
    bodies_of,
    compensated,
    gravity_of,
    of_inertia,
    random_positions,
)
from sb3_hds.twins.mujoco.rigid_body.dynamics import Tree, configuration, inverse_dynamics

if TYPE_CHECKING:
    from sb3_hds.twins.mujoco.twin import MechanismTwin

_N_MOTIONS = 64
# Complex step, in scales of a parameter: the derivative is exact to rounding.
_STEP = 1e-20
# Singular values below this share of the largest, and entries of unit vectors below this, are zero.
_RANK, _SHARE = 1e-9, 1e-5
_FEW = 6


def unidentifiable(twin: "MechanismTwin") -> str:
    """
    :return: a sentence on the masses, centres, inertias and armatures that no data can identify, or
        only in combinations; empty if there are none

    Source: Khalil and Dombre, *Modeling, Identification and Control of Robots*, Kogan Page 2002,
    section 9.4.
    """
    names = inertial(twin)
    slopes = regressor(twin, names)
    size = np.linalg.norm(slopes, axis=0)
    visible = size >= _RANK * size.max()
    scaled = slopes[:, visible] / size[visible]
    _, values, directions = np.linalg.svd(scaled, full_matrices=True)
    null_space = directions[int(np.sum(values > _RANK * values[0])) :]
    combined = np.linalg.norm(null_space, axis=0) >= _SHARE
    idle = np.array(names)[~visible].tolist()
    together = np.array(names)[visible][combined].tolist()
    parts = []
    if idle:
        parts.append(f"{len(idle)} change nothing ({first_names(idle, _FEW)})")
    if together:
        parts.append(
            f"{len(together)} act only in {len(together) - len(null_space)} combinations "
            f"({first_names(together, _FEW)})"
        )
    if not parts:
        return ""
    return (
        f"Of {len(names)} inertial parameters of {twin.name}, {', and '.join(parts)}: no data can "
        "identify these one by one. Estimate fewer of them, or calibrate with a prior."
    )


def inertial(twin: "MechanismTwin") -> list[str]:
    """:return: names of the parameters of masses and inertias"""
    mechanism = twin.mechanism
    bodies = [link.body.name for link in mechanism.links if link.body]
    found = [name for body in bodies for name in of_inertia(body)]
    found += [f"{link.joint}_armature" for link in mechanism.links]
    return [name for name in found if name in twin.parameters]


def regressor(twin: "MechanismTwin", names: list[str]) -> Float[np.ndarray, "rows p"]:
    """:return: derivatives of inverse dynamics of random motions by the scaled parameters"""
    mechanism = twin.mechanism
    tree, rng = Tree(mechanism.links), np.random.default_rng(0)
    q = random_positions(mechanism, _N_MOTIONS)
    v, a = rng.normal(size=(2, _N_MOTIONS, tree.n))
    values = {name: float(value) for name, value in twin.values.items()}
    columns = []
    for name in names:
        if name.endswith("_armature"):
            link = next(x for x in mechanism.links if f"{x.joint}_armature" == name)
            dofs = np.isin(np.arange(tree.n), link.dofs)
            columns.append((a * dofs * twin.parameters[name].scale).ravel())
            continue
        p = values | {name: np.asarray(values[name] + 1j * _STEP * twin.parameters[name].scale)}
        at = configuration(
            tree, q, bodies_of(mechanism, twin.payload, twin.masses, p), compensated(mechanism)
        )
        force = inverse_dynamics(tree, at, v, gravity_of(mechanism, values), a)
        columns.append(np.imag(force).ravel() / _STEP)
    return np.stack(columns, 1)
