"""Windows of the measured data: which of them count, and which are held out."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sb3_hds.core import Params, Trajectories, Twin
from sb3_hds.effects import force_of
from sb3_hds.sysid.estimation.calibrate import default_window
from sb3_hds.sysid.estimation.prediction import has_grown, hold_out, window_errors
from sb3_hds.sysid.estimation.shooting import Shots, places_and_ages_of, shots_of

# A twin whose window errors are below this share of the channels' deviations needs no correction.
EXACT = 1e-3
# Fewest windows of which some can be held out.
FEWEST = 6
# Rows of the compiled programs: the latest windows are used.
_N_WINDOWS = 128
# Share of held-out windows, that share for few windows, and the number from which there are many.
_HELD, _HELD_OF_FEW, _MANY = 0.25, 0.5, 24


class ChangePoint(NamedTuple):
    """
    Where the data start that count after a change of the system.

    :param n_steps: number of steps since then
    :param recording: number of the recording in which they start
    """

    n_steps: int
    recording: int


class Windows(NamedTuple):
    """
    Windows of data on which models are compared.

    :param shots: windows of the data
    :param origin: recording of each window; negative: the window does not count
    :param place: position of each window in its recording
    :param age: steps from the start of each window to the end of the data
    :param std: standard deviation of each channel
    :param held_out: whether each window is held out
    """

    shots: Shots
    origin: np.ndarray
    place: np.ndarray
    age: np.ndarray
    std: Float[np.ndarray, " obs"]
    held_out: np.ndarray

    @property
    def counted(self) -> np.ndarray:
        """Indices of the windows that count, oldest first."""
        return np.flatnonzero(self.origin >= 0)

    @property
    def held_out_by_recording(self) -> bool:
        """Whether the recordings of held-out windows have no others."""
        learned = self.origin[~self.held_out & (self.origin >= 0)]
        return not np.isin(self.origin[self.held_out], learned).any()

    @property
    def learned(self) -> Shots:
        """The windows that are not held out."""
        return self.shots._replace(weight=self.shots.weight * ~self.held_out)

    def errors(self, twin: Twin, params: Params | None = None) -> np.ndarray:
        """:return: error of each window with these parameters; None: the twin's, without force"""
        if params is None:
            params = twin.params | no_force(twin)
        return window_errors(twin, params, self.shots, self.std)


def windows_of(
    data: Trajectories, twin: Twin, std: Float[np.ndarray, " obs"], change: ChangePoint | None
) -> Windows:
    """:return: the latest windows, none of them held out"""
    length = default_window(data)
    shots, origin = shots_of(data, length, twin, _N_WINDOWS, seed=None)
    place, age = places_and_ages_of(data, length, _N_WINDOWS, seed=None)
    windows = Windows(shots, origin, place, age, std, np.zeros(len(origin), bool))
    return windows if change is None else _leave_out(windows, np.flatnonzero(age > change.n_steps))


def _leave_out(windows: Windows, left_out: np.ndarray) -> Windows:
    weight, origin = windows.shots.weight.copy(), windows.origin.copy()
    weight[left_out], origin[left_out] = 0.0, -1
    return windows._replace(shots=windows.shots._replace(weight=weight), origin=origin)


def latest_windows(windows: Windows, n_new: int) -> np.ndarray:
    """:return: indices of the windows since the last correction, at least of ``FEWEST``"""
    counted = windows.counted
    n_latest = int(np.sum(windows.age[counted] <= n_new))
    return counted[-max(FEWEST, n_latest) :]


def detect_change(
    windows: Windows, errors: np.ndarray, latest: np.ndarray, n_new: int
) -> tuple[Windows, ChangePoint | None]:
    """Leave out data from before the last correction if the system has changed since."""
    older = np.setdiff1d(windows.counted, latest)
    if len(older) < FEWEST or rms(errors[latest]) < EXACT:
        return windows, None
    if not has_grown(errors[latest], errors[older]):
        return windows, None
    # `latest` may contain windows from before the last correction.
    counted = windows.counted
    newest = counted[windows.age[counted] <= n_new]
    recording = windows.origin[newest[0] if len(newest) else counted[-1]]
    return _leave_out(windows, np.setdiff1d(counted, newest)), ChangePoint(n_new, int(recording))


def hold_out_windows(windows: Windows, change: ChangePoint | None) -> Windows:
    """Hold out windows by recording and position, so that the choice is stable as data grow."""
    first = 0 if change is None else change.recording
    number = np.where(windows.origin >= 0, windows.origin - first, -1)
    share = _HELD if len(windows.counted) >= _MANY else _HELD_OF_FEW
    return windows._replace(held_out=hold_out(number, windows.place, share))


def force_share_name(twin: Twin) -> str | None:
    """:return: full name of the parameter that scales the learned force, if there is one"""
    force = force_of(twin)
    return None if force is None else f"{force[0]}.share"


def no_force(twin: Twin) -> dict[str, float]:
    """:return: the parameter value that switches the learned force off, if there is one"""
    name = force_share_name(twin)
    return {} if name is None else {name: 0.0}


def rms(errors: np.ndarray) -> float:
    """:return: root mean square over windows; NaN without windows"""
    return float(np.sqrt(np.mean(errors**2))) if len(errors) else float("nan")
