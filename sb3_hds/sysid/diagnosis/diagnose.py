"""Find out what a simulation gets wrong: propose on some recordings, confirm once on others."""

from collections.abc import Iterable, Mapping, Sequence
from numbers import Integral
from typing import Any, Literal

from sb3_hds.core import Effect, Trajectories, Twin
from sb3_hds.core.belief import BeliefTwin
from sb3_hds.core.contract import check_methods
from sb3_hds.core.numerics.compilation import cache_compiled_programs
from sb3_hds.effects import ALL, effect_named
from sb3_hds.errors import CalibrationError, EffectError
from sb3_hds.sysid.diagnosis.pipeline import EFFORTS, Inquiry
from sb3_hds.sysid.estimation.parameters import Belief
from sb3_hds.sysid.measurements import check_fits, refuse_slow
from sb3_hds.sysid.progress import Bar
from sb3_hds.sysid.reporting.diagnosis import Diagnosis

_DESCRIBED = ("name", "slot", "parameters", "explanation")  # what a finding is told with


def diagnose(
    twin: Twin,
    data: Trajectories,
    *,
    effects: type[Effect] | str | Sequence[type[Effect] | str] = ALL,
    calibrate: str | Sequence[str] | Mapping[str, Belief] = (),
    seed: int = 0,
    budget: Literal["full", "quick"] = "full",
    progress: bool = True,
) -> Diagnosis:
    """
    Name what a simulation gets wrong, if the data can.

    The data are audited first: data that cannot support a verdict are refused with the reason,
    other defects become caveats. Candidates are screened by equation errors if the twin has an
    equation of motion, and a set of several causes is then confirmed by simulation as a whole.
    Otherwise single candidates are fitted to half of the recordings, by simulation of short windows
    with free start states (multiple shooting). The best is confirmed on the other half: 5 % lower
    mean square error, and a one-sided t test on the log error ratios of the recordings or a score
    test. Candidates that are not significantly worse there become alternatives. After each cause,
    everything is tested again. A cause is not named if it leaves too much of the predictable
    residual force, or if its size is not constant. Finally, all causes are fitted to all
    recordings.

    :param twin: nominal model; of a belief over several, the likeliest
    :param data: measured, sampled at the twin's ``dt``
    :param effects: classes of the catalogue, their names, or classes of your own
    :param calibrate: nuisance parameters: they are refitted under every hypothesis, and are never a
        finding. The prior of each is normal around the twin's value with the parameter's ``scale``
        as its standard deviation, within a factor of 20: ``{"mass": 3.0}`` widens it three times,
        ``{"mass": (0.5, 8.0)}`` sets other bounds. Where one ends at a bound, nothing is named.
    :param seed: of the split
    :param budget: ``"full"``, or ``"quick"``: fewer candidates are fitted to the end
    :param progress: whether a bar shows how far it is, with an estimate of the time left
    :return: verdict, findings, what was rejected, what cannot be told apart, the extended twin
    :raises CalibrationError: for other channels or another interval than the twin's, or an unknown
        name in ``calibrate``, or a twin on MuJoCo's engine
    :raises EffectError: for an unknown effect, or a twin whose step does not use effects
    :raises TwinError: for a twin whose methods do not return what they have to
    :raises TrajectoryError: if no recording is long enough
    """
    if not isinstance(twin, Twin) or not isinstance(data, Trajectories):
        raise CalibrationError(
            f"diagnose(twin, data) takes a twin, as from twins.make(...), and Trajectories, got "
            f"{type(twin).__name__} and {type(data).__name__}."
        )
    twin = twin.member(0) if isinstance(twin, BeliefTwin) else twin
    check_methods(twin)
    refuse_slow(twin, "diagnose")
    cache_compiled_programs()
    check_fits(twin, data)
    if budget not in EFFORTS:
        raise CalibrationError(f"budget must be 'full' or 'quick', got {budget!r}.")
    if not isinstance(seed, Integral) or seed < 0:
        raise CalibrationError(f"seed must be a whole number of at least 0, got {seed!r}.")
    kinds, nuisances = classes_of(effects), _beliefs_of(calibrate)
    with Bar(progress) as bar:
        inquiry = Inquiry(twin, data, kinds, nuisances, int(seed), budget, bar)
        reason = inquiry.given.reason_to_refuse
        return inquiry.refused(reason) if reason else inquiry.run()


def _beliefs_of(calibrate: str | Iterable[str] | Mapping[str, Belief]) -> dict[str, Belief]:
    """:return: by names of parameters, of which a single one may stand alone"""
    if isinstance(calibrate, str):
        return {calibrate: None}
    names = tuple(calibrate) if isinstance(calibrate, Iterable) else (calibrate,)
    if not all(isinstance(name, str) for name in names):
        raise CalibrationError(
            f"calibrate is a list of names of parameters, such as ['mass'], got {calibrate!r}. "
            "Leave it out where all of them are believed."
        )
    return dict(calibrate) if isinstance(calibrate, Mapping) else dict.fromkeys(names)


def classes_of(
    effects: type[Effect] | str | Iterable[type[Effect] | str],
) -> tuple[type[Effect], ...]:
    """
    :param effects: classes, or names of the catalogue, of which a single one may stand alone:
        ``"coulomb_friction"`` or ``"CoulombFriction"``
    :raises EffectError: for anything else
    """
    given: list[Any] = [effects]
    if isinstance(effects, Iterable) and not isinstance(effects, str | type):
        given = list(effects)
    found = [effect_named(one, ALL) if isinstance(one, str) else one for one in given]
    wrong = [one for one in found if not (isinstance(one, type) and issubclass(one, Effect))]
    if wrong:
        raise EffectError(
            f"effects are classes, such as sb3_hds.effects.CoulombFriction, or their names, got "
            f"{wrong[0]!r}. Leave them out to try the whole catalogue."
        )
    for kind in found:
        _check_described(kind)
    return tuple(found)


def _check_described(kind: type[Effect]) -> None:
    missing = [name for name in _DESCRIBED if not hasattr(kind, name)]
    if missing:
        raise EffectError(
            f"The effect {kind.__name__} lacks {', '.join(missing)}: an effect that is looked for "
            "says what it is called, where it acts, what its parameters are, and what it is, in "
            f"one sentence. Write it into the class: {missing[0]} = ..."
        )
