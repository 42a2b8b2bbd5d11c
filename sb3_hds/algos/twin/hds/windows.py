"""Windows of what was measured: which of them count, and which are held out."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from sb3_hds.core import Params, Trajectories, Twin
from sb3_hds.effects import force_of
from sb3_hds.sysid.estimation.calibrate import default_window
from sb3_hds.sysid.estimation.prediction import has_grown, hold_out, window_errors
from sb3_hds.sysid.estimation.shooting import Shots, places_of, shots_of

# A twin whose window errors are below this share of the channels' deviations needs no correction.
EXACT = 1e-3
# Fewer windows than this are too few to check on some what was learned from others.
FEWEST = 6
# Rows of the compiled programs: the latest windows are used.
_N_WINDOWS = 128
# Share of windows to check on, and that share where there are not many.
_HELD, _HELD_OF_FEW, _MANY = 0.25, 0.5, 24


class ChangePoint(NamedTuple):
    """
    The data that count after the system has changed.

    :param n_steps: the latest of them
    :param recording: number of the recording in which they begin
    """

    n_steps: int
    recording: int


class Windows(NamedTuple):
    """
    Windows of data on which models are compared.

    :param shots: windows of the data
    :param origin: of each window, the recording it is from; negative where it does not count
    :param place: of each window in its recording
    :param age: of each window, steps from its beginning to the end of the data
    :param std: standard deviation of each channel
    :param held: whether each window is held out of what is learned from
    """

    shots: Shots
    origin: np.ndarray
    place: np.ndarray
    age: np.ndarray
    std: Float[np.ndarray, " obs"]
    held: np.ndarray

    @property
    def counted(self) -> np.ndarray:
        """Indices of those that count, oldest first."""
        return np.flatnonzero(self.origin >= 0)

    @property
    def held_out_by_recording(self) -> bool:
        """Whether nothing is learned from the recordings that windows are held out of."""
        learned = self.origin[~self.held & (self.origin >= 0)]
        return not np.isin(self.origin[self.held], learned).any()

    @property
    def learned(self) -> Shots:
        """Those that are not held out."""
        return self.shots._replace(weight=self.shots.weight * ~self.held)

    def errors(self, twin: Twin, params: Params | None = None) -> np.ndarray:
        """:return: of each window, with these parameters; None: the twin's, without its force"""
        params = without_force(twin) if params is None else params
        return window_errors(twin, params, self.shots, self.std)


def windows_of(
    data: Trajectories, twin: Twin, std: Float[np.ndarray, " obs"], change: ChangePoint | None
) -> Windows:
    """The latest windows, not yet divided into those to learn from and those to check on."""
    length = default_window(data)
    shots, origin = shots_of(data, length, twin, _N_WINDOWS, seed=None)
    place, age = places_of(data, length, _N_WINDOWS, seed=None)
    windows = Windows(shots, origin, place, age, std, np.zeros(len(origin), bool))
    return windows if change is None else _leave_out(windows, np.flatnonzero(age > change.n_steps))


def _leave_out(windows: Windows, left_out: np.ndarray) -> Windows:
    weight, origin = windows.shots.weight.copy(), windows.origin.copy()
    weight[left_out], origin[left_out] = 0.0, -1
    return windows._replace(shots=windows.shots._replace(weight=weight), origin=origin)


def latest_windows(windows: Windows, n_new: int) -> np.ndarray:
    """:return: indices of the windows that came since the last correction"""
    counted = windows.counted
    n_latest = int(np.sum(windows.age[counted] <= n_new))
    return counted[-max(FEWEST, n_latest) :]


def detect_change(
    windows: Windows, errors: np.ndarray, latest: np.ndarray, n_new: int
) -> tuple[Windows, ChangePoint | None]:
    """
    Leave out what was measured before the last correction, if the system has become another one.
    """
    older = np.setdiff1d(windows.counted, latest)
    if len(older) < FEWEST or rms(errors[latest]) < EXACT:
        return windows, None
    if not has_grown(errors[latest], errors[older]):
        return windows, None
    # The latest may be more than came since then.
    counted = windows.counted
    newest = counted[windows.age[counted] <= n_new]
    recording = windows.origin[newest[0] if len(newest) else counted[-1]]
    return _leave_out(windows, np.setdiff1d(counted, newest)), ChangePoint(n_new, int(recording))


def hold_out_windows(windows: Windows, change: ChangePoint | None) -> Windows:
    """Which windows are held out depends on nothing that moves on with the data."""
    first = 0 if change is None else change.recording
    number = np.where(windows.origin >= 0, windows.origin - first, -1)
    share = _HELD if len(windows.counted) >= _MANY else _HELD_OF_FEW
    return windows._replace(held=hold_out(number, windows.place, share))


def shares_of(twin: Twin) -> tuple[str, ...]:
    """:return: full name of the parameter that says how much of a learned force acts, if any"""
    force = force_of(twin)
    return () if force is None else (f"{force[0]}.share",)


def without_force(twin: Twin) -> dict[str, Any]:
    """:return: its parameters, with none of its learned force acting"""
    return twin.params | dict.fromkeys(shares_of(twin), 0.0)


def rms(errors: np.ndarray) -> float:
    """:return: root mean square over windows; not a number of none"""
    return float(np.sqrt(np.mean(errors**2))) if len(errors) else float("nan")
