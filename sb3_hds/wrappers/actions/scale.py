"""A reduced range of commands, constant or scheduled."""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np

from sb3_hds.core import Scale
from sb3_hds.errors import ParameterError
from sb3_hds.wrappers.action_layer import TransformLayer


class ActionScale(TransformLayer):
    """
    Scales actions to a share of the command range, around its middle: a constant share, or one that
    follows a schedule over the steps of this copy of the environment.

    The action space is unchanged. With a schedule, its progress from 0 to 1 is appended to
    observations and continues across resets; a reset with a seed restarts it. An evaluation
    environment has its own progress, which also starts at 0: pass ``progress=1.0`` there, or see
    :meth:`set_progress`.

    :param env: with a bounded Box of one axis as action space
    :param scale: the share, above 0 and at most 1
    :param schedule: ``[[0, 0.3], [10_000, 1.0]]``: shares at step 0 and from step 10,000 on, linear
        between; instead of ``scale``
    :param axes: indices of the scaled actions, such as ``[0]`` for steering alone; None: all
    :param progress: initial progress of the schedule, from 0 to 1; 1 to evaluate a trained policy
    :param observe_state: whether the progress is appended
    :param store: ``"executed"``: learners store the action that corresponds to the executed command
    :raises ParameterError: for a share or a schedule out of range, or both, or for axes that the
        actions do not have
    """

    def __init__(
        self,
        env: gymnasium.Env,
        scale: float | None = None,
        schedule: Sequence[Sequence[float]] | None = None,
        *,
        axes: Sequence[int] | None = None,
        progress: float = 0.0,
        observe_state: bool = True,
        store: str = "raw",
    ) -> None:
        if (scale is None) == (schedule is None):
            raise ParameterError(
                f"ActionScale takes either a scale or a schedule, got scale={scale} and "
                f"schedule={schedule}."
            )
        if not 0.0 <= progress <= 1.0:
            raise ParameterError(f"ActionScale(progress={progress}): progress is from 0 to 1.")
        if axes is not None and np.ndim(axes) != 1:
            raise ParameterError(f"ActionScale(axes={axes!r}): axes is a list of numbers: [0].")
        points = [[0.0, scale]] if schedule is None else schedule
        self._scale = Scale(schedule=_schedule_of(points), axes=axes, observed=observe_state)
        super().__init__(
            env,
            self._scale,
            store,
            scale=scale,
            schedule=schedule,
            axes=axes,
            progress=progress,
            observe_state=observe_state,
        )
        self._start = self._memory
        self.set_progress(progress)
        self._share = self._shares()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        if seed is not None:
            self._memory = self._start
        return super().reset(seed=seed, options=options)

    def set_progress(self, progress: float) -> None:
        """
        Set the progress of the schedule, for example to that of training; later resets with a seed
        restart from it. Call it through ``VecEnv.env_method``. No effect without a schedule.

        :param progress: from 0 to 1
        """
        if self._scale.length:
            self._memory = self._start = np.array([np.clip(progress, 0.0, 1.0)])

    def decide(self, action: np.ndarray) -> np.ndarray:
        self._share = self._shares()
        return super().decide(action)

    def nominal(self, action: np.ndarray) -> np.ndarray:
        return self._middle + self._share * (super().nominal(action) - self._middle)

    def action_for(self, command: np.ndarray) -> np.ndarray:
        wanted = self._middle + (command - self._middle) / self._share
        return np.clip(wanted, self.commands.low, self.commands.high)

    def _shares(self) -> np.ndarray:
        return np.asarray(self._scale.share(self._memory, self.commands.shape[0]))

    @property
    def _middle(self) -> np.ndarray:
        return 0.5 * (self.commands.low.astype(float) + self.commands.high)


def _schedule_of(schedule: Any) -> list[list[float]]:
    """
    :return: steps and shares
    :raises ParameterError: for anything but pairs of numbers
    """
    try:
        return [[float(step), float(share)] for step, share in schedule]
    except (TypeError, ValueError):
        raise ParameterError(
            f"ActionScale(schedule={schedule!r}): a schedule is a list of pairs of a step and a "
            "share, such as [[0, 0.3], [10_000, 1.0]]."
        ) from None
