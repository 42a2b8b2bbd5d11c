"""Lists of episodes of unequal length: validated, and padded to one length."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from sb3_hds.errors import TrajectoryError

#: relative difference below which two sampling rates count as equal
SAME_RATE = 1e-3


def check_dt(dt: Any) -> float:
    """
    :return: the sampling interval as a float [s]
    :raises TrajectoryError: if it is not a finite positive number
    """
    try:
        value = float(dt)
    except (TypeError, ValueError):
        value = math.nan
    if not 0.0 < value < math.inf:
        raise TrajectoryError(
            f"dt must be the sampling interval in seconds, finite and positive, got {dt!r}."
        )
    return value


def same_interval(dt: float, other: float) -> bool:
    """Whether two sampling intervals agree to 0.1 %, the accuracy of logs."""
    return math.isclose(dt, other, rel_tol=SAME_RATE)


def check_episodes(
    obs: Iterable[Any], actions: Iterable[Any]
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """
    :param obs: one array of shape ``(T + 1, n_obs)`` per episode
    :param actions: one array of shape ``(T, n_act)`` per episode
    :return: both as float64
    :raises TrajectoryError: for a wrong shape, number or content, with the array and the sample
    """
    obs = [_matrix("obs", i, x, "(T + 1, n_obs)") for i, x in enumerate(obs)]
    actions = [_matrix("actions", i, x, "(T, n_act)") for i, x in enumerate(actions)]
    if not obs or len(obs) != len(actions):
        raise TrajectoryError(
            "obs and actions must be lists with one array per trajectory, "
            f"got {len(obs)} in obs and {len(actions)} in actions."
        )
    for i, (x, u) in enumerate(zip(obs, actions, strict=True)):
        _check_lengths(i, len(x), len(u))
    _check_widths("obs", obs)
    _check_widths("actions", actions)
    return obs, actions


def check_conditions(conditions: str | Iterable[Any] | None, n: int) -> tuple[str, ...]:
    """
    :return: one label per trajectory
    :raises TrajectoryError: if their number is not that of the trajectories
    """
    if conditions is None or isinstance(conditions, str):
        return (conditions or "default",) * n
    labels = tuple(str(label) for label in conditions)
    if len(labels) != n:
        raise TrajectoryError(
            f"conditions must hold one label per trajectory, got {len(labels)} for {n}. "
            "Pass a list, or one string for all of them."
        )
    return labels


def pad(
    obs: Sequence[np.ndarray], actions: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    :return: observations, shape ``(n, T + 1, n_obs)``, padded with the last one; actions, shape
        ``(n, T, n_act)``, padded with zeros; and a mask that is False for padding, shape ``(n, T)``
    """
    lengths = np.array([len(u) for u in actions])
    longest = int(lengths.max())
    padded_obs = np.stack([np.pad(x, ((0, longest + 1 - len(x)), (0, 0)), "edge") for x in obs])
    padded_actions = np.stack([np.pad(u, ((0, longest - len(u)), (0, 0))) for u in actions])
    return padded_obs, padded_actions, np.arange(longest) < lengths[:, None]


def resample(
    obs: np.ndarray, actions: np.ndarray, ratio: float, n_steps: int, angles: Sequence[int] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """
    Resample one episode: actions are held, observations interpolated linearly.

    :param obs: shape ``(T + 1, n_obs)``
    :param actions: shape ``(T, n_act)``
    :param ratio: new interval by old interval
    :param n_steps: length of the result, at most ``T / ratio``
    :param angles: columns of ``obs`` with angles wrapped to [-pi, pi); interpolated along the
        shorter way
    :return: observations, shape ``(n_steps + 1, n_obs)``, and actions, shape ``(n_steps, n_act)``
    """
    time = np.arange(n_steps + 1) * ratio  # [old steps]
    rounded = np.round(time)
    time = np.where(np.abs(time - rounded) < 1e-6, rounded, time)
    step = np.minimum(time.astype(int), len(actions) - 1)
    weight = (time - step)[:, None]
    before, after = obs[step], obs[step + 1]
    columns = list(angles)
    turn = after[:, columns] - before[:, columns]
    after[:, columns] -= 2.0 * np.pi * np.round(turn / (2.0 * np.pi))
    mixed = (1.0 - weight) * before + weight * after
    mixed[:, columns] -= 2.0 * np.pi * np.floor(mixed[:, columns] / (2.0 * np.pi) + 0.5)
    return mixed, actions[step[:-1]]


def _matrix(argument: str, i: int, array: Any, shape: str) -> np.ndarray:
    try:
        matrix = np.asarray(array)
        numeric = matrix.dtype.kind in "fiub"
    except ValueError:  # rows of unequal length
        matrix, numeric = np.empty(0), False
    if not numeric:
        raise TrajectoryError(
            f"{argument}[{i}] must be an array of real numbers of shape {shape}, "
            f"got {type(array).__name__} of dtype {matrix.dtype}."
        )
    if matrix.ndim != 2:
        raise TrajectoryError(
            f"{argument}[{i}] must have shape {shape}, got {matrix.shape}. A single channel needs "
            f"reshape(-1, 1); a single trajectory needs a list around it: {argument}=[array]."
        )
    bad = np.argwhere(~np.isfinite(matrix))
    if len(bad):
        row, column = bad[0]
        raise TrajectoryError(
            f"{argument}[{i}] must be finite, got {matrix[row, column]} at row {row}, "
            f"column {column} ({len(bad)} such values in all). Cut the trajectory before it."
        )
    return matrix.astype(np.float64)


def _check_lengths(i: int, n_obs: int, n_actions: int) -> None:
    if n_obs == n_actions + 1 and n_actions > 0:
        return
    hint = "Action k acts from observation k to observation k + 1."
    if n_obs == n_actions:
        hint += " If the log ends with an action, drop that one: actions=[a[:-1] for a in actions]."
    elif n_actions == n_obs + 1:
        hint += " Are obs and actions swapped?"
    raise TrajectoryError(
        f"obs[{i}] must have one row more than actions[{i}], and there must be at least one "
        f"action; got {n_obs} and {n_actions} rows. {hint}"
    )


def _check_widths(argument: str, arrays: Sequence[np.ndarray]) -> None:
    for i, array in enumerate(arrays):
        if array.shape[1] != arrays[0].shape[1]:
            raise TrajectoryError(
                f"All trajectories must have the same channels, but {argument}[0] has "
                f"{arrays[0].shape[1]} columns and {argument}[{i}] has {array.shape[1]}."
            )
