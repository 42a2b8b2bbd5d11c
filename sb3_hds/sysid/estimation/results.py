"""Results of a calibration, which print themselves with their caveats."""

import dataclasses
import math
import textwrap
from collections.abc import Mapping
from typing import Any

import numpy as np

from sb3_hds.core import Params, Twin

_WIDTH = 80


@dataclasses.dataclass(frozen=True)
class Estimate:
    """
    One parameter.

    :param name: full name
    :param estimate: in ``unit``
    :param stderr: standard error; infinite where the data do not determine the parameter
    :param low: lower end of the confidence interval
    :param high: upper end of it
    :param unit: of all of these
    :param before: value with which the search began
    :param at_bound: whether the estimate lies on a physical bound; standard errors mean little then
    :param added_to: value that the twin has of it already, to which the estimate is added, in
        ``unit``
    """

    name: str
    estimate: float
    stderr: float
    low: float
    high: float
    unit: str
    before: float
    at_bound: bool
    added_to: float = 0.0


@dataclasses.dataclass(frozen=True, repr=False)
class Fit:
    """
    Result of :func:`~sb3_hds.sysid.calibrate`.

    :param twin: with the estimated values
    :param estimates: one for each free parameter, in the order given
    :param covariance: of the estimates, shape ``(p, p)``
    :param channels: name and unit of each observation
    :param error_before: root mean square error of each channel over the windows, with the values
        before and start states fitted, in its unit, shape ``(n_obs,)``
    :param error_after: the same with the estimates
    :param noise: estimated standard deviation of each channel's noise, shape ``(n_obs,)``
    :param n_windows: windows used
    :param window: steps of each
    :param n_groups: independent clusters: recordings, or windows
    :param level: of the confidence intervals
    :param converged: whether the solver converged
    :param n_steps: of the solver
    :param undetermined: groups of parameters of which the data determine only combinations
    :param errors: that were minimised: ``"simulation"`` or ``"force"``
    """

    twin: Twin
    estimates: tuple[Estimate, ...]
    covariance: np.ndarray
    channels: tuple[tuple[str, str], ...]
    error_before: np.ndarray
    error_after: np.ndarray
    noise: np.ndarray
    n_windows: int
    window: int
    n_groups: int
    level: float
    converged: bool
    n_steps: int
    undetermined: tuple[str, ...]
    errors: str = "simulation"

    @property
    def params(self) -> Params:
        """All parameters of the calibrated twin."""
        return self.twin.params

    def __getitem__(self, name: str) -> Estimate:
        """:raises KeyError: for a parameter that was not free"""
        by_name = {estimate.name: estimate for estimate in self.estimates}
        if name not in by_name:
            raise KeyError(f"'{name}' was not free. Estimated were: {', '.join(by_name)}.")
        return by_name[name]

    @property
    def caveats(self) -> tuple[str, ...]:
        """What to know before trusting the numbers, a sentence each."""
        found = []
        if not self.converged:
            found.append(f"The solver did not converge in {self.n_steps} steps.")
        for group in self.undetermined:
            found.append(
                f"The data do not determine {group}: only combinations of them. Fix some of them, "
                "or give a prior."
            )
        bounded = [e.name for e in self.estimates if e.at_bound]
        if bounded:
            found.append(
                f"On its physical bound: {', '.join(bounded)}. Its interval is not reliable."
            )
        return tuple(found)

    def to_dict(self) -> dict[str, Any]:
        """:return: plain data, ready for JSON; what is not finite is None"""
        errors = zip(self.error_before, self.error_after, self.noise, strict=True)
        channels = [
            {"name": name, "unit": unit, "before": before, "after": after, "noise": noise}
            for (name, unit), (before, after, noise) in zip(self.channels, errors, strict=True)
        ]
        told = {"twin": self.twin.name, "estimates": self.estimates, "covariance": self.covariance}
        told |= {"channels": channels}
        others = ("n_windows", "window", "n_groups", "level", "errors", "converged", "n_steps")
        return plain(told | {name: getattr(self, name) for name in (*others, "caveats")})

    def __repr__(self) -> str:
        share = f"{100.0 * self.level:g} %"
        of = "the forces of " if self.errors == "force" else ""
        names = ["parameter", "channel", *(e.name for e in self.estimates)]
        w = max(map(len, [*names, *(name for name, _ in self.channels)])) + 1
        lines = [
            f"Fit of {self.twin.name} to {of}{self.n_windows} windows of {self.window} steps",
            "",
            f"{'parameter':<{w}}{'before':>10}{'estimate':>11}{'+-':>9}   {share} interval",
        ]
        for e in self.estimates:
            numbers = f"{e.before:>10.4g}{e.estimate:>11.4g}{e.stderr:>9.2g}"
            interval = f"[{e.low:.4g}, {e.high:.4g}] {e.unit}"
            lines.append(f"{e.name:<{w}}{numbers}   {interval}")
        lines += ["", f"{'channel':<{w}}{'error before':>16}{'after':>12}{'noise':>12}"]
        for (name, unit), b, a, n in zip(
            self.channels, self.error_before, self.error_after, self.noise, strict=True
        ):
            before = f"{b:.3g}" if math.isfinite(b) else "diverges"
            lines.append(f"{name:<{w}}{before:>16}{a:>12.3g}{n:>12.3g} {unit}")
        for caveat in self.caveats:
            lines += ["", *textwrap.wrap(caveat, _WIDTH)]
        return "\n".join(lines)

    def plot(self, path: Any) -> None:
        """
        Draw the estimates with their intervals, relative to the values before, and the errors.

        :param path: of the picture, for example ``"fit.png"``
        """
        from sb3_hds.sysid.reporting.figures import plot_fit

        plot_fit(self, path)


def plain(value: Any) -> Any:
    """:return: the same for JSON: dictionaries, lists, numbers; what is not finite is None"""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return plain({f.name: getattr(value, f.name) for f in dataclasses.fields(value)})
    if isinstance(value, Mapping):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
