"""Validation of actions and reset options, before any compiled program runs."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_hds.core import State, Twin


def check_action(twin: Twin, action: Any, shape: tuple[int, ...]) -> np.ndarray:
    """
    :param shape: ``(n_act,)``, or ``(n_envs, n_act)`` for several copies
    :return: the action as float32
    :raises ValueError: for another shape, or numbers that are not finite
    """
    names = ", ".join(f"{a.name} [{a.unit}]" for a in twin.actuators)
    action = np.asarray(action, np.float32)
    if action.shape != shape:
        raise ValueError(
            f"{twin.name} takes actions of shape {shape} ({names}), got shape {action.shape}."
        )
    if not np.isfinite(action).all():
        raise ValueError(f"{twin.name} takes finite actions ({names}), got {action.tolist()}.")
    return action


def start_state(twin: Twin, drawn: State, options: Mapping[str, Any] | None) -> State:
    """
    The state that the episode starts from.

    :param drawn: random start state; used without ``options``, and for the memory of effects
    :param options: None, empty, or ``{"state": (q, v)}``
    :raises ValueError: for an unknown option, or a state of the wrong size or not finite
    """
    unknown = set(options or ()) - {"state"}
    if unknown:
        raise ValueError(
            f"The only option of reset() of {twin.name} is 'state', got "
            f"{sorted(map(str, unknown))}."
        )
    if not options:
        return drawn
    try:
        q, v = (np.array(part, drawn.q.dtype).reshape(-1) for part in options["state"])
        fits = q.shape == drawn.q.shape and v.shape == drawn.v.shape
        if not (fits and np.isfinite(q).all() and np.isfinite(v).all()):
            raise ValueError
    except (TypeError, ValueError):
        joints = ", ".join(f"{joint.name} [{joint.unit}]" for joint in twin.joints)
        raise ValueError(
            f"reset(options={{'state': (q, v)}}) of {twin.name} takes {drawn.q.size} finite "
            f"positions and {drawn.v.size} finite velocities ({joints}), got "
            f"{options['state']!r}."
        ) from None
    return drawn._replace(q=q, v=v)


def check_start(
    twin: Twin, space: spaces.Box, obs: np.ndarray, options: Mapping[str, Any] | None
) -> None:
    """:raises ValueError: if the state in ``options`` cannot be observed within ``space``"""
    if options and not space.contains(obs):
        outside = [
            f"{c.name} = {value:g} {c.unit} (from {c.low:g} to {c.high:g})"
            for c, value in zip(twin.channels, obs.tolist(), strict=True)
            if not c.low <= value <= c.high
        ]
        raise ValueError(
            f"reset(options={{'state': ...}}) of {twin.name} leaves the observation space: "
            f"{', '.join(outside)}."
        )
