"""Parameters of Gymnasium's inverted pendulums, read from a compiled MuJoCo model."""

from typing import Any

from sb3_hds.errors import EnvironmentMismatchError

_RK4 = 1  # mjtIntegrator.mjINT_RK4
_SLIDE, _HINGE = 2, 3  # mjtJoint


def read(env: Any, poles: int) -> dict[str, Any]:
    """
    Read a cart on a rail in x that carries a chain of poles swinging about y.

    Names are those of ``InvertedDoublePendulum``: ``pole`` is the first pole, ``pole2`` the second.

    :param env: an environment, wrapped or not, whose ``unwrapped`` has a compiled MuJoCo ``model``
    :param poles: how many poles there are
    :return: values of parameters, and the settings ``dt``, ``substeps`` and ``reset_noise_scale``
    :raises EnvironmentMismatchError: for features that the equations of motion do not have
    """
    env = env.unwrapped
    model, gravity = env.model, env.model.opt.gravity
    _check(model, poles)
    found = {
        "gravity": -gravity[2],
        "gravity_x": gravity[0],
        "gear": model.actuator_gear[0, 0],
        "cart_mass": model.body_mass[1],
        "dt": env.dt,
        "substeps": env.frame_skip,
        "reset_noise_scale": env._reset_noise_scale,
    }
    for joint in range(1 + poles):
        name = _numbered("hinge", joint) if joint else "slider"
        found[f"{name}_damping"] = model.dof_damping[joint]
        found[f"{name}_armature"] = model.dof_armature[joint]
    for pole in range(1, 1 + poles):
        name, body = _numbered("pole", pole), pole + 1
        com = model.body_ipos[body] - model.jnt_pos[pole]
        found[f"{name}_mass"] = model.body_mass[body]
        found[f"{name}_com"] = com[2]
        found[f"{name}_com_offset"] = com[0]
        found[f"{name}_inertia"] = _inertia_about_y(
            model.body_iquat[body], model.body_inertia[body]
        )
    return {name: float(value) for name, value in found.items()} | {"substeps": env.frame_skip}


def require(condition: Any, expected: str) -> None:
    """:raises EnvironmentMismatchError: if the model violates an assumption of the twin"""
    if not condition:
        raise EnvironmentMismatchError(
            f"The twin expects {expected}, and the environment's XML differs. Masses, shapes, "
            "damping, armature, gravity, gear and time step may change; for anything else, pass "
            "your own twin."
        )


def _check(model: Any, poles: int) -> None:
    dof, upright = 1 + poles, [1.0, 0.0, 0.0, 0.0]
    require(model.nq == dof and model.nv == dof, f"a slider and {poles} hinge(s)")
    require(list(model.jnt_type) == [_SLIDE] + [_HINGE] * poles, "the slider first, then hinges")
    axes = [[1.0, 0.0, 0.0]] + [[0.0, 1.0, 0.0]] * poles
    require((model.jnt_axis == axes).all(), "a slider along x and hinges about y")
    require((model.body_quat == upright).all(), "bodies that are not rotated in their parents")
    require(not model.body_pos[:3].any(), "the first hinge in the origin")
    require(not model.jnt_pos.any(), "joints in the origins of their bodies")
    require(not model.dof_frictionloss.any(), "joints without dry friction")
    require(not model.jnt_stiffness.any(), "joints without springs")
    require(not model.body_gravcomp.any(), "bodies without gravity compensation")
    option = model.opt
    require(option.integrator == _RK4, "the integrator RK4")
    require(option.density == 0.0 and option.viscosity == 0.0, "no medium around the bodies")
    require(option.gravity[1] == 0.0, "gravity in the plane of the poles")
    require(model.nu == 1 and model.actuator_trnid[0, 0] == 0, "one motor, on the slider")
    require(
        model.actuator_gainprm[0, 0] == 1.0 and not model.actuator_biasprm.any(), "a plain motor"
    )


def _numbered(name: str, number: int) -> str:
    return name if number == 1 else f"{name}{number}"


def _inertia_about_y(quaternion: Any, principal: Any) -> float:
    """Moment of inertia about the body's y axis [kg m2], from principal moments and their frame."""
    w, x, y, z = quaternion
    row = (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x))
    return sum(r**2 * moment for r, moment in zip(row, principal, strict=True))
