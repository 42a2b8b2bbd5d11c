"""Joint limits, enforced by a control barrier function."""

import math
import warnings
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np

from sb3_hds.core import Barrier
from sb3_hds.errors import ParameterError, SafetyError
from sb3_hds.wrappers.action_layer import ActionLayer, TransformLayer
from sb3_hds.wrappers.interval import interval_of

# Rounding error of two positions and a speed in single precision, relative to the largest limit.
_ROUNDING = 1e-6
_ON_BREACH = ("raise", "warn", "ignore")


class JointLimitBarrier(TransformLayer):
    r"""
    Bounds the speed towards a joint limit by the distance to it, as
    :class:`~sb3_hds.core.Barrier`:

    .. math:: u \le \frac{\gamma\,(q_\text{max} - q) - \varepsilon}{\Delta t}

    Assumes velocity-controlled joints with a tracking error of at most ``tolerance`` per step,
    speed limits that allow standing still, and episodes that begin within the limits. These
    assumptions are checked at construction where possible, otherwise at every reset and step. The
    barrier must be next to the environment: a layer below it would change its commands.

    ``info["constraint_cost"]`` is the distance of joints beyond their limits, and
    ``info["tracking_error"]`` that from their commanded positions.

    :param env: its observations are a Box with one axis that contains the positions
    :param low: lower limit [rad] or [m], one number or one per guarded joint
    :param high: upper limit
    :param position: index of each joint's position in the observation, or for an angle the two
        indices of its cosine and sine
    :param action: index of each joint's speed command; default: 0, 1, ...
    :param gain: speed per unit of the command [rad/s] or [m/s]
    :param share: :math:`\gamma`, above 0 and at most 1: the largest share of the distance per step
    :param tolerance: :math:`\varepsilon`, tracking error per step [rad] or [m]; default: the
        rounding error of single precision
    :param dt: control interval [s]; default: the environment's own ``dt`` or ``tau``
    :param on_breach: what to do if an assumption is violated: ``"raise"``, ``"warn"`` or
        ``"ignore"``
    :param store: ``"executed"``: learners store the bounded command
    :raises ParameterError: for numbers out of range, or another layer below
    """

    def __init__(
        self,
        env: gymnasium.Env,
        low: float | Sequence[float],
        high: float | Sequence[float],
        position: Sequence[int | Sequence[int]] = (0,),
        action: Sequence[int] | None = None,
        *,
        gain: float = 1.0,
        share: float = 0.5,
        tolerance: float | None = None,
        dt: float | None = None,
        on_breach: str = "raise",
        store: str = "raw",
    ) -> None:
        arguments = {
            "low": low,
            "high": high,
            "position": position,
            "action": action,
            "gain": gain,
            "share": share,
            "tolerance": tolerance,
            "dt": dt,
            "on_breach": on_breach,
        }
        refuse_layers_below(type(self), env)
        self._on_breach = check_on_breach(type(self), on_breach)
        n = _count(position)
        lows, highs = _one_each("low", low, n), _one_each("high", high, n)
        if tolerance is None:
            tolerance = _ROUNDING * float(np.max(np.abs([lows, highs])))
        self._barrier = Barrier(
            low=lows.tolist(),
            high=highs.tolist(),
            position=position,
            action=list(range(n)) if action is None else action,
            gain=_number("gain", gain),
            share=_number("share", share),
            tolerance=_number("tolerance", tolerance),
            dt=interval_of(env, ParameterError) if dt is None else float(dt),
        )
        super().__init__(env, self._barrier, store, **arguments)
        self._turns = np.array([not isinstance(place, int) for place in self._barrier.position])
        self._tracking_error = 0.0

    def begin(self, obs: Any) -> None:
        super().begin(obs)
        self._tracking_error = 0.0
        if not self.cost() <= self._barrier.tolerance:
            self._breach(
                f"An episode begins {self.cost():.3g} beyond the joint limits, at "
                f"{self._barrier.positions(self._obs)}. Start within them."
            )

    def observe(self, obs: Any, command: np.ndarray) -> None:
        barrier, before = self._barrier, self._barrier.positions(self._obs)
        super().observe(obs, command)
        speed = barrier.gain * command[list(barrier.action)].astype(float)
        error = barrier.positions(self._obs) - before - speed * barrier.dt
        turned = (error + math.pi) % (2.0 * math.pi) - math.pi
        self._tracking_error = float(np.max(np.abs(np.where(self._turns, turned, error))))
        if not self._tracking_error <= barrier.tolerance:
            self._breach(
                f"A joint missed its commanded position by {self._tracking_error:.3g}, and the "
                f"barrier assumes at most {barrier.tolerance:.3g}. It protects velocity-controlled "
                "joints: check gain, dt, position and action, or pass the tolerance of the drive."
            )

    def cost(self) -> float:
        return float(self._barrier.violation(self._obs))

    def extra_info(self) -> dict[str, Any]:
        return {"tracking_error": self._tracking_error}

    def _breach(self, message: str) -> None:
        report_breach(self._on_breach, message)


def _count(position: Any) -> int:
    """
    :return: number of guarded joints
    :raises ParameterError: unless each has an index, or the indices of its cosine and sine
    """
    places = position if isinstance(position, Sequence) and not isinstance(position, str) else []
    if not places or not all(isinstance(p, int) or _is_pair(p) for p in places):
        raise ParameterError(
            f"JointLimitBarrier(position={position!r}): position is a list with, for each guarded "
            "joint, the index of its position in the observation, or the two indices of its cosine "
            "and sine, such as [0, [1, 2]]."
        )
    return len(places)


def _is_pair(place: Any) -> bool:
    return (
        isinstance(place, Sequence) and len(place) == 2 and all(isinstance(i, int) for i in place)
    )


def _one_each(name: str, value: Any, n: int) -> np.ndarray:
    try:
        return np.broadcast_to(np.asarray(value, float), (n,))
    except ValueError:
        raise ParameterError(
            f"JointLimitBarrier({name}={value!r}): {name} is one number, or one for each of the "
            f"{n} joints that position names."
        ) from None


def _number(name: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        raise ParameterError(
            f"JointLimitBarrier({name}={value!r}): {name} is one number for all joints."
        ) from None


def report_breach(on_breach: str, message: str) -> None:
    """:raises SafetyError: with the message, if ``on_breach`` is ``"raise"``"""
    if on_breach == "raise":
        raise SafetyError(message)
    if on_breach == "warn":
        warnings.warn(message)


def check_on_breach(layer: type, on_breach: str) -> str:
    """:raises ParameterError: for anything but ``"raise"``, ``"warn"`` and ``"ignore"``"""
    if on_breach not in _ON_BREACH:
        raise ParameterError(
            f"{layer.__name__}(on_breach={on_breach!r}): on_breach must be one of {_ON_BREACH}."
        )
    return on_breach


def refuse_layers_below(layer: type, env: gymnasium.Env) -> None:
    """:raises ParameterError: if a layer below would change the commands of a safety layer"""
    below = env
    while isinstance(below, gymnasium.Wrapper):
        if isinstance(below, ActionLayer) and below.alters_commands:
            raise ParameterError(
                f"{layer.__name__} must have the last word, but {type(below).__name__} below it "
                "changes commands. Swap the two: wrap with the safety layer first."
            )
        below = below.env
