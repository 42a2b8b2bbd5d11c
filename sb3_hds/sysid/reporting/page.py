"""A diagnosis as one self-contained HTML page."""

import base64
import os
from collections.abc import Callable, Mapping
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_hds.core import Twin
from sb3_hds.core.trajectories.storage import check_target, write_bytes
from sb3_hds.errors import ParameterError
from sb3_hds.sysid.design.result import NextExperiment
from sb3_hds.sysid.reporting import figures as plots
from sb3_hds.sysid.reporting import wording
from sb3_hds.sysid.reporting.animation import animate
from sb3_hds.sysid.reporting.diagnosis import Diagnosis
from sb3_hds.sysid.reporting.finding import Finding
from sb3_hds.sysid.reporting.printed import COLUMNS, alike_in_words, rows_of

_INSTALL = "A report needs matplotlib and jinja2: pip install 'sb3-hds[report]'."
_COLOURS = {"named": "#27496d", "ambiguous": "#8a6d1d", "unknown": "#d1495b"}
_NO_NAME = "#6b6860"


def check_installed() -> None:
    """:raises ImportError: without matplotlib and jinja2"""
    if not all(map(find_spec, ("jinja2", "matplotlib"))):
        raise ImportError(_INSTALL)


def check_page(path: str | os.PathLike[str]) -> None:
    """
    :raises ParameterError: for a file name that does not end in ``.html``
    :raises OSError: if there is no folder to write it in
    """
    if Path(path).suffix.lower() not in (".html", ".htm"):
        raise ParameterError(
            f"A report is an HTML page: name it {Path(path).with_suffix('.html')} in place of "
            f"{path}. A browser prints it as PDF."
        )
    check_target(path)


class _Picture(NamedTuple):
    """
    :param draw: returns the figure, for a narrow page or a wide one
    :param rows: of a table below it
    :param shown: whether there is anything to draw
    """

    title: str
    caption: str
    draw: Callable[[bool], Any]
    rows: tuple[tuple[str, ...], ...] = ()
    shown: bool = True


def write_report(
    diagnosis: Diagnosis,
    path: str | os.PathLike[str],
    policy_gain: Mapping[str, Any] | None = None,
    experiment: NextExperiment | None = None,
) -> Path:
    """
    :param path: of the page; an existing file is replaced
    :param policy_gain: as plain data
    :param experiment: what to record next
    :raises ImportError: without matplotlib and jinja2
    :raises ParameterError: for a file name that does not end in ``.html``
    :raises OSError: if there is no folder to write it in
    """
    check_page(path)
    check_installed()
    text = template("page.html").render(
        **_content(diagnosis),
        pictures=[_inlined(picture) for picture in _pictures(diagnosis)],
        policy=_policy(policy_gain),
        experiment=_experiment(experiment),
    )
    return write_bytes(path, text.encode())


def template(name: str) -> Any:
    """:return: a Jinja template of the folder ``templates``"""
    import jinja2

    loader = jinja2.FileSystemLoader(Path(__file__).parent / "templates")
    options = {"autoescape": True, "undefined": jinja2.StrictUndefined}
    return jinja2.Environment(loader=loader, **options).get_template(name)


def write_pictures(diagnosis: Diagnosis, folder: str | os.PathLike[str]) -> list[Path]:
    """
    :param folder: is created if it does not exist; existing files are replaced
    :return: one PNG for each picture of the report
    :raises ImportError: without matplotlib and jinja2
    """
    check_installed()
    Path(folder).mkdir(parents=True, exist_ok=True)
    return [
        write_bytes(
            Path(folder) / f"{picture.title.lower().replace(' ', '_')}.png",
            plots.as_png(picture.draw(False)),
        )
        for picture in _pictures(diagnosis)
    ]


def _content(d: Diagnosis) -> dict[str, Any]:
    n = 0 if d.pictures is None else len(np.unique(d.pictures.missing.origin))
    return {
        "d": d,
        "moving": d.pictures and animate(d.believed, d.twin, d.pictures.replay).section(),
        "wording": wording,
        "n_recordings": f"{n} recordings" if n > 1 else "its recording",
        "colour": _COLOURS.get(d.verdict, _NO_NAME),
        "sizes_of": _sizes_of,
        "COLUMNS": COLUMNS,
        "causes": rows_of(d.findings, [joint.name for joint in d.believed.joints]),
        "alike": alike_in_words(d.findings),
        "rejected": [
            (r.name, wording.share_in_words(r.gain), wording.p_value_in_words(r.p_value), r.why)
            for r in d.rejected
        ],
        "parameters": _parameters(d),
        "detectable": [
            (key, wording.sizes_in_words(d.twin, key, sizes) or "none")
            for key, sizes in d.detectable.items()
        ],
    }


def _sizes_of(finding: Finding) -> list[tuple[str, ...]]:
    """Name, estimate, standard error and interval of each parameter."""
    return [
        (name, wording.size_in_words(e), f"{e.stderr:.2g}", wording.interval_in_words(e))
        for name, e in finding.parameters.items()
    ]


def _parameters(d: Diagnosis) -> list[tuple[str, str, str]]:
    """Name, value as believed, value in the extended twin."""

    def value(twin: Twin, name: str) -> str:
        unit = d.twin.parameters[name].unit
        return wording.with_unit(f"{twin.values[name]:.4g}", unit) if name in twin.values else ""

    return [(name, value(d.believed, name), value(d.twin, name)) for name in d.twin.values]


def _policy(gain: Mapping[str, Any] | None) -> dict[str, Any] | None:
    if gain is None:
        return None
    caption = "Dots: runs. Lines: interquartile means. Bars: their 90 % intervals over runs."
    if gain["runs"] == 1:
        caption = "Dots: start states of the one run. Lines: interquartile means of these."
    draw = partial(plots.plot_policy_gain, gain)
    picture = _inlined(_Picture("Return on the real system", caption, draw))
    return {"picture": picture, "told": wording.policy_in_words(gain)}


def _experiment(designed: NextExperiment | None) -> dict[str, Any] | None:
    if designed is None:
        return None
    caption = (
        "The first of the recordings: the commands, and each channel as every answer predicts it "
        "from the start state without correction."
    )
    return {
        "sentence": designed.sentence,
        "picture": _inlined(_Picture("Commands and predicted motions", caption, designed.figure)),
        "pairs": designed.told_apart(),
        "usage": [(name, f"{share:.0%}") for name, share in designed.usage.items()],
        "would_tell": designed.would_tell,
    }


def _pictures(d: Diagnosis) -> list[_Picture]:
    p = d.pictures
    if p is None:
        return []
    horizons = tuple(
        (str(g.steps), f"{g.before:.3g}", f"{g.after:.3g}", f"{g.low:.0%} to {g.high:.0%}")
        for g in d.gain.values()
    )
    found = [
        _Picture(
            "Before and after",
            "Held-out stretches, in windows that are simulated from a start state of their own. "
            "Shaded: 90 % interval of the extended twin, by what it misses in all such windows. "
            "Where the nominal model runs away, its curve is cut off.",
            partial(plots.plot_rollouts, p),
        ),
        _Picture(
            "Error against horizon",
            "Root mean square over all held-out windows and channels, in units of what the best "
            "fit of any candidate leaves: the noise, where one of them is right. Bars: 90 % "
            "interval of the gain.",
            partial(plots.plot_horizons, d, p),
            horizons,
        ),
        _Picture(
            "Friction against velocity",
            "Dots: the mean resistance while a joint moves at about that velocity, by the equation "
            "of motion, with all other causes taken off. Line: the friction that was found.",
            partial(plots.plot_friction, p),
            shown=bool(p.friction),
        ),
        _Picture(
            "The missing force",
            "What each short window asks for beyond the twin: grey as measured, blue what the "
            "causes that were found put there.",
            partial(plots.plot_missing_force, p),
        ),
        _Picture(
            "The evidence for every candidate",
            "By how much each candidate lowers the mean square error of held-out recordings; "
            "dashed: the least that counts.",
            partial(plots.plot_evidence, d),
            shown=bool(d.rejected or d.findings),
        ),
    ]
    return [picture for picture in found if picture.shown]


def _inlined(picture: _Picture) -> dict[str, Any]:
    wide, narrow = (
        base64.b64encode(plots.as_png(picture.draw(narrow))).decode() for narrow in (False, True)
    )
    return picture._asdict() | {"wide": wide, "narrow": narrow}
