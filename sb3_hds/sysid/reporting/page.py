"""A diagnosis as one page that needs no network."""

import base64
import os
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_hds.core.trajectories.storage import check_target, write_bytes
from sb3_hds.errors import ParameterError
from sb3_hds.sysid.design.plots import plot_next
from sb3_hds.sysid.design.result import NextExperiment
from sb3_hds.sysid.reporting import figures as plots
from sb3_hds.sysid.reporting import wording
from sb3_hds.sysid.reporting.diagnosis import Diagnosis
from sb3_hds.sysid.reporting.film import STYLE, section_of
from sb3_hds.sysid.reporting.moving import moving_of
from sb3_hds.sysid.reporting.printed import COLUMNS, alike_in_words, rows_of
from sb3_hds.sysid.reporting.wording import sizes_in_words, with_unit

_INSTALL = "A report needs matplotlib and jinja2: pip install 'sb3-hds[report]'."
_COLOURS = {"named": "#27496d", "ambiguous": "#8a6d1d", "unknown": "#d1495b"}
_NO_NAME = "#6b6860"

_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title>
<style>
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 60rem; padding: 1.5rem 1rem 3rem; color: #2b2a27;
  background: #fff; font: 16px/1.5 system-ui, "Segoe UI", "Liberation Sans", sans-serif; }
h1 { font-size: 1.7rem; line-height: 1.25; margin: 0 0 .4rem; overflow-wrap: anywhere; }
h1.long { font-size: 1.25rem; }
h2 { font-size: 1.15rem; margin: 0 0 .5rem; border-bottom: 1px solid #dcd9d0;
  break-after: avoid; }
section { margin: 2.2rem 0 0; }
p { margin: .4rem 0; overflow-wrap: anywhere; } figure { margin: .8rem 0; }
figure img { display: block; width: 100%; height: auto; }
figcaption, .quiet { color: #6b6860; font-size: .9rem; }
.badge { display: inline-block; padding: .1rem .6rem; border-radius: 1rem; color: #fff;
  background: {{ colour }}; font-size: .9rem; print-color-adjust: exact; }
.finding { border-left: .3rem solid #27496d; padding: .3rem .9rem; margin: .9rem 0;
  background: #f6f7f9; }
table { border-collapse: collapse; width: 100%; font-size: .95rem; }
th, td { text-align: left; padding: .25rem .8rem .25rem 0; border-bottom: 1px solid #eceae3;
  vertical-align: top; font-variant-numeric: tabular-nums; overflow-wrap: anywhere; }
.causes { overflow-x: auto; } .causes td { overflow-wrap: break-word; }
th { font-weight: 600; font-size: .9rem; overflow-wrap: normal; }
{{ style | safe }}
td.short { white-space: nowrap; }
@media screen and (max-width: 40rem) { h1 { font-size: 1.35rem; }
  h1.long { font-size: 1.1rem; } table { font-size: .8rem; }
  th, td { padding-right: .4rem; } th { font-size: .8rem; } }
@media print { @page { margin: 1.6cm; }
  body { font-size: 10pt; max-width: none; padding: 0; }
  h2 + p { break-after: avoid; } figure, .finding, .picture, tr { break-inside: avoid; }
  figure img { width: auto; max-width: 100%; max-height: 22cm; margin: 0 auto; } }
</style></head><body>
{%- macro table(columns, rows) %}
<table><thead><tr>{% for c in columns %}<th>{{ c }}</th>{% endfor %}</tr></thead><tbody>
{% for row in rows %}<tr>{% for cell in row -%}
<td{% if cell | length < 10 %} class="short"{% endif %}>
{{- cell | replace("_", "_<wbr>" | safe) }}</td>
{%- endfor %}</tr>
{% endfor %}</tbody></table>
{%- endmacro %}
{%- macro shown(picture) %}
<figure><picture>
<source media="screen and (max-width: 40rem)" srcset="data:image/png;base64,{{ picture.narrow }}">
<img src="data:image/png;base64,{{ picture.wide }}" alt="{{ picture.title }}">
</picture><figcaption>{{ picture.caption }}</figcaption></figure>
{%- endmacro %}
<p class="quiet">{{ d.twin.name }} and {{ n_recordings }}</p>
<h1{% if d.headline | length > 160 %} class="long"{% endif %}>{{ d.headline }}</h1>
<p><span class="badge">{{ d.verdict }}</span></p>
{% if d.tabled %}<div class="causes">{{ table(COLUMNS, causes) }}</div>
{% for words in alike %}<p class="quiet">{{ words }}</p>{% endfor %}
{% else %}{% for f in findings %}<div class="finding">
<p><strong>{{ f.effect }}</strong>{% if f.place %} at {{ f.slot }}
<strong>{{ f.place }}</strong>{% endif %}. {{ f.explanation }}</p>
{{ table(("parameter", "estimate", "standard error", "90 % interval"), f.rows) }}
<p>{{ f.evidence }}{% if f.alternatives %} <strong>{{ wording.ALIKE }}</strong>
{{ f.alternatives }}.{% endif %}</p>
</div>{% endfor %}{% endif %}
{% if findings %}<p>{{ explained }}</p>{% endif %}
{% if d.unexplained %}<p><strong>Unexplained:</strong> {{ d.unexplained }}</p>{% endif %}
{% for caveat in d.caveats %}<p><strong>Caveat:</strong> {{ caveat }}</p>{% endfor %}
{{ moving | safe }}
{% for picture in pictures %}<section class="picture"><h2>{{ picture.title }}</h2>
{{ shown(picture) }}{% if picture.rows %}<p class="quiet">{{ wording.HORIZONS }}:</p>
{{ table(("steps", "before", "after", "90 % interval of the gain"), picture.rows) }}{% endif %}
</section>{% endfor %}
{% if experiment %}<section class="picture"><h2>What to record next</h2>
<p>{{ experiment.sentence }}</p>{{ shown(experiment.picture) }}
{% if experiment.pairs %}{{ table(("if this is right", "this is ruled out with a chance of",
"recordings for 90 %"), experiment.pairs) }}{% endif %}
{{ table(("limit", "most that any answer takes"), experiment.usage) }}
{% for words in experiment.would_tell %}<p>{{ words }}</p>{% endfor %}</section>{% endif %}
{% if rejected %}<section><h2>Not accepted</h2>
<p class="quiet">{{ wording.REJECTED }}.</p>
{{ table(("candidate", "gain", "p", "why"), rejected) }}</section>{% endif %}
{% if policy %}<section class="picture"><h2>What it buys</h2>
<p>{{ policy.told.measured }}.</p>
{{ shown(policy.picture) }}
{{ table(policy.told.columns, policy.told.rows) }}
{% for note in policy.told.notes %}<p class="quiet">{{ note }}</p>{% endfor %}</section>{% endif %}
{% if parameters %}<section><h2>Parameters of the extended twin</h2>
{{ table(("parameter", "as believed", "extended"), parameters) }}</section>{% endif %}
{% if detectable %}<section><h2>What these data would have shown</h2>
<p class="quiet">The smallest size of each candidate that lowers the error by 5 %, to first order.
Where there is none, the effect cannot be seen by its slope at zero.</p>
{{ table(("candidate", "smallest size"), detectable) }}</section>{% endif %}
<p class="quiet">{{ d.made_with }}</p>
</body></html>
"""


def check_installed() -> None:
    """:raises ImportError: without matplotlib and jinja2"""
    if not all(map(find_spec, ("jinja2", "matplotlib"))):
        raise ImportError(_INSTALL)


def check_page(path: str | os.PathLike[str]) -> None:
    """
    :raises ParameterError: for a name that is none of a page
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
    :param draw: called with whether the picture is for a narrow page
    :param rows: of a table below it
    """

    title: str
    caption: str
    draw: Callable[[bool], Any]
    rows: tuple[tuple[str, ...], ...] = ()


def write_report(
    diagnosis: Diagnosis,
    path: str | os.PathLike[str],
    policy_gain: Mapping[str, Any] | None = None,
    experiment: NextExperiment | None = None,
) -> Path:
    """
    :param path: of the page; a file of that name is replaced as a whole
    :param policy_gain: as plain data
    :param experiment: what to record next
    :raises ImportError: without matplotlib and jinja2
    :raises ParameterError: for a name that is none of a page
    :raises OSError: if there is no folder to write it in
    """
    check_page(path)
    check_installed()
    import jinja2

    pictures = [_inlined(picture) for picture in _pictures(diagnosis)]
    page = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    text = page.from_string(_PAGE).render(
        **_content(diagnosis),
        pictures=pictures,
        policy=_policy(policy_gain),
        experiment=_experiment(experiment),
        style=STYLE,
        moving=_moving(diagnosis),
    )
    return write_bytes(path, text.encode())


def write_pictures(diagnosis: Diagnosis, folder: str | os.PathLike[str]) -> list[Path]:
    """
    :param folder: is made where it is missing; files of the same names are replaced
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


def _moving(d: Diagnosis) -> str:
    """Nothing where nothing was simulated."""
    return (
        "" if d.pictures is None else section_of(moving_of(d.believed, d.twin, d.pictures.replay))
    )


def _content(d: Diagnosis) -> dict[str, Any]:
    findings = [
        {
            "effect": f.effect,
            "slot": f.where["slot"],
            "place": "" if f.where["slot"] == "parameter" else f.where["name"],
            "explanation": f.explanation,
            "rows": [
                (
                    name,
                    wording.size_in_words(e),
                    f"{e.stderr:.2g}",
                    wording.interval_in_words(e),
                )
                for name, e in f.parameters.items()
            ],
            "evidence": wording.evidence_in_words(f.gain, f.p_value),
            "alternatives": ", ".join(f.alternatives),
        }
        for f in d.findings
    ]
    n = 0 if d.pictures is None else len(np.unique(d.pictures.missing.origin))
    return {
        "d": d,
        "wording": wording,
        "title": f"{d.twin.name}: {d.verdict}",
        "n_recordings": f"{n} recordings" if n > 1 else "its recording",
        "colour": _COLOURS.get(d.verdict, _NO_NAME),
        "findings": findings,
        "COLUMNS": COLUMNS,
        "causes": rows_of(d.findings, [joint.name for joint in d.believed.joints]),
        "alike": alike_in_words(d.findings),
        "explained": wording.explained_in_words(d.explained),
        "rejected": [
            (r.name, wording.share_in_words(r.gain), wording.p_value_in_words(r.p_value), r.why)
            for r in d.rejected
        ],
        "parameters": _parameters(d),
        "detectable": [
            (key, sizes_in_words(d.twin, key, sizes) or "none")
            for key, sizes in d.detectable.items()
        ],
    }


def _parameters(d: Diagnosis) -> list[tuple[str, str, str]]:
    """Name, value as believed, value in the extended twin."""
    rows = []
    for name, value in d.twin.values.items():
        before = d.believed.values.get(name)
        unit = d.twin.parameters[name].unit
        rows.append(
            (
                name,
                "" if before is None else with_unit(f"{before:.4g}", unit),
                with_unit(f"{value:.4g}", unit),
            )
        )
    return rows


def _policy(gain: Mapping[str, Any] | None) -> dict[str, Any] | None:
    if gain is None:
        return None
    caption = "Dots: runs. Lines: interquartile means. Bars: their 90 % intervals over runs."
    if gain["runs"] == 1:
        caption = "Dots: start states of the one run. Lines: interquartile means of these."
    picture = _Picture(
        "Return on the real system",
        caption,
        lambda narrow: plots.plot_policy_gain(gain, narrow),
    )
    return {"picture": _inlined(picture), "told": wording.policy_in_words(gain)}


def _experiment(told: NextExperiment | None) -> dict[str, Any] | None:
    if told is None:
        return None
    picture = _Picture(
        "Commands and predicted motions",
        "The first of the recordings: the commands, and each channel as every answer predicts it "
        "from the start state without correction.",
        lambda narrow: plot_next(told, narrow),
    )
    return {
        "sentence": told.sentence,
        "picture": _inlined(picture),
        "pairs": told.told_apart(),
        "usage": [(name, f"{share:.0%}") for name, share in told.usage.items()],
        "would_tell": told.would_tell,
    }


def _pictures(d: Diagnosis) -> list[_Picture]:
    p = d.pictures
    if p is None:
        return []
    found = [
        _Picture(
            "Before and after",
            "Held-out stretches, in windows that are simulated from a start state of their own. "
            "Shaded: 90 % interval of the extended twin, by what it misses in all such windows. "
            "Where the nominal model runs away, its curve is cut off.",
            lambda narrow: plots.plot_rollouts(p, narrow),
        ),
        _Picture(
            "Error against horizon",
            "Root mean square over all held-out windows and channels, in units of what the best "
            "fit of any candidate leaves: the noise, where one of them is right. Bars: 90 % "
            "interval of the gain.",
            lambda narrow: plots.plot_horizons(d, p, narrow),
            tuple(
                (str(g.steps), f"{g.before:.3g}", f"{g.after:.3g}", f"{g.low:.0%} to {g.high:.0%}")
                for g in d.gain.values()
            ),
        ),
    ]
    if p.friction:
        found.append(
            _Picture(
                "Friction against velocity",
                "Dots: the mean resistance while a joint moves at about that velocity, by the "
                "equation of motion, with all other causes taken off. Line: the friction that was "
                "found.",
                lambda narrow: plots.plot_friction(p, narrow),
            )
        )
    found.append(
        _Picture(
            "The missing force",
            "What each short window asks for beyond the twin: grey as measured, blue what the "
            "causes that were found put there.",
            lambda narrow: plots.plot_missing_force(p, narrow),
        )
    )
    if d.rejected or d.findings:
        caption = (
            "By how much each candidate lowers the mean square error of held-out recordings; "
            "dashed: the least that counts."
        )
        found.append(
            _Picture(
                "The evidence for every candidate",
                caption,
                lambda narrow: plots.plot_evidence(d, narrow),
            )
        )
    return found


def _inlined(picture: _Picture) -> dict[str, Any]:
    wide, narrow = (
        base64.b64encode(plots.as_png(picture.draw(narrow))).decode() for narrow in (False, True)
    )
    return picture._asdict() | {"wide": wide, "narrow": narrow}
