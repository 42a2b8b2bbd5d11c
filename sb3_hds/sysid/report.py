"""A diagnosis as one page that needs no network."""

import base64
import io
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_hds.core.storage import write_bytes
from sb3_hds.sysid.diagnosis import SENTENCES, Diagnosis

if TYPE_CHECKING:
    from sb3_hds.sysid.pictures import Pictures

_MEASURED, _BEFORE, _AFTER, _QUIET = "#3b3a36", "#d1495b", "#27496d", "#9a978c"
_INSTALL = "A report needs matplotlib and jinja2: pip install 'sb3-hds[report]'."

_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title>
<style>
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 60rem; padding: 1.5rem 1rem 3rem; color: #2b2a27;
  background: #fff; font: 16px/1.5 system-ui, "Segoe UI", "Liberation Sans", sans-serif; }
h1 { font-size: 1.7rem; line-height: 1.25; margin: 0 0 .3rem; }
h2 { font-size: 1.15rem; margin: 2.2rem 0 .5rem; border-bottom: 1px solid #dcd9d0; }
p { margin: .4rem 0; } figure { margin: 1rem 0; }
figure img { display: block; width: 100%; height: auto; }
figcaption, .quiet { color: #6b6860; font-size: .9rem; }
.badge { display: inline-block; padding: .1rem .6rem; border-radius: 1rem; color: #fff;
  background: {{ colour }}; font-size: .9rem; }
.finding { border-left: .3rem solid #27496d; padding: .3rem .9rem; margin: .9rem 0;
  background: #f6f7f9; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; width: 100%; }
th, td { text-align: left; padding: .25rem .8rem .25rem 0; border-bottom: 1px solid #eceae3;
  vertical-align: top; font-variant-numeric: tabular-nums; overflow-wrap: anywhere; }
th { font-weight: 600; font-size: .9rem; } code { overflow-wrap: anywhere; }
@media print { body { font-size: 11pt; max-width: none; }
  figure, .finding { break-inside: avoid; } }
</style></head><body>
<p class="quiet">{{ twin }} and {{ n_recordings }}</p>
<h1>{{ sentence }}</h1>
<p><span class="badge">{{ d.verdict }}</span></p>
{% for f in findings %}<section class="finding">
<p><strong>{{ f.effect }}</strong> at {{ f.slot }} <strong>{{ f.place }}</strong>.
{{ f.explanation }}</p>
<div class="scroll"><table><tr><th>parameter</th><th>estimate</th><th>90 % interval</th></tr>
{% for row in f.rows %}<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>{% endfor %}
</table></div>
<p>It lowers the mean square error of held-out recordings by {{ f.gain }} (p = {{ f.p }}).
{% if f.alternatives %}These data cannot tell it from: {{ f.alternatives }}.{% endif %}</p>
</section>{% endfor %}
{% if d.unexplained %}<p><strong>Unexplained:</strong> {{ d.unexplained }}</p>{% endif %}
{% for caveat in d.caveats %}<p><strong>Caveat:</strong> {{ caveat }}</p>{% endfor %}
{% for picture in pictures %}<h2>{{ picture.title }}</h2>
<figure><img src="data:image/png;base64,{{ picture.data }}" alt="{{ picture.title }}"
width="{{ picture.width }}" height="{{ picture.height }}">
<figcaption>{{ picture.caption }}</figcaption></figure>{% endfor %}
{% if policy %}<h2>What it buys</h2>
<p>Return on the real system of policies that were trained in each simulation: interquartile mean
over {{ policy.runs }} runs and {{ policy.episodes }} start states each.</p>
<div class="scroll"><table><tr><th>trained in</th><th>return</th><th>90 % interval</th></tr>
{% for row in policy.rows %}<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</table></div>{% endif %}
{% if d.detectable %}<h2>What these data would have shown</h2>
<p class="quiet">The smallest size of each candidate that lowers the error by 5 %, to first order.
Where there is none, the effect cannot be seen by its slope at zero.</p>
<div class="scroll"><table><tr><th>candidate</th><th>smallest size</th></tr>
{% for name, sizes in detectable %}<tr><td>{{ name }}</td><td>{{ sizes }}</td></tr>{% endfor %}
</table></div>{% endif %}
<p class="quiet">Data {{ d.data_hash }}, seed {{ d.seed }}{% for name, v in d.versions.items() %},
{{ name }} {{ v }}{% endfor %}.</p>
</body></html>
"""


def write_report(
    diagnosis: Diagnosis,
    path: str | os.PathLike[str],
    policy_gain: Mapping[str, Any] | None = None,
) -> Path:
    """
    :param path: of the page; a file of that name is replaced as a whole
    :param policy_gain: as plain data
    :raises ImportError: without matplotlib and jinja2
    """
    try:
        import jinja2
    except ImportError as error:
        raise ImportError(_INSTALL) from error
    pictures = [
        {**picture, "data": base64.b64encode(picture["data"]).decode()}
        for picture in _drawn(diagnosis)
    ]
    page = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    text = page.from_string(_PAGE).render(
        **_content(diagnosis), pictures=pictures, policy=_policy(policy_gain)
    )
    return write_bytes(path, text.encode())


def write_pictures(diagnosis: Diagnosis, folder: str | os.PathLike[str]) -> list[Path]:
    """
    :param folder: is made where it is missing; files of the same names are replaced
    :return: one PNG for each picture of the report
    :raises ImportError: without matplotlib
    """
    Path(folder).mkdir(parents=True, exist_ok=True)
    return [
        write_bytes(
            Path(folder) / f"{picture['title'].lower().replace(' ', '_')}.png", picture["data"]
        )
        for picture in _drawn(diagnosis)
    ]


def _content(d: Diagnosis) -> dict[str, Any]:
    colours = {"named": "#27496d", "ambiguous": "#8a6d1d", "unknown": "#d1495b"}
    findings = [
        {
            "effect": f.effect,
            "slot": f.where["slot"],
            "place": f.where["name"],
            "explanation": f.explanation,
            "rows": [
                (name, f"{e.estimate:.4g} {e.unit}", f"{e.low:.4g} to {e.high:.4g}")
                for name, e in f.parameters.items()
            ],
            "gain": f"{f.gain:.0%}",
            "p": f"{f.p_value:.2g}",
            "alternatives": ", ".join(f.alternatives),
        }
        for f in d.findings
    ]
    detectable = [
        (name, ", ".join(f"{n} {v:.2g}" for n, v in sizes.items() if np.isfinite(v)) or "none")
        for name, sizes in d.detectable.items()
    ]
    n = 0 if d.pictures is None else len(np.unique(d.pictures.missing.origin))
    return {
        "d": d,
        "title": f"{d.twin.name}: {d.verdict}",
        "twin": d.twin.name,
        "n_recordings": f"{n} recordings" if n else "its recordings",
        "sentence": _sentence(d),
        "colour": colours.get(d.verdict, _QUIET),
        "findings": findings,
        "detectable": detectable,
    }


def _policy(gain: Mapping[str, Any] | None) -> dict[str, Any] | None:
    if gain is None:
        return None
    names = {"believed": "the twin as believed", "extended": "the extended twin"}
    rows = [(names.get(name, "the true twin"), r) for name, r in gain["simulations"].items()]
    rows.append(("gain, extended over believed", gain["gain"]))
    return {
        "runs": gain["runs"],
        "episodes": gain["episodes"],
        "rows": [
            (name, f"{r['mean']:.1f}", f"{r['low']:.1f} to {r['high']:.1f}") for name, r in rows
        ],
    }


def _sentence(d: Diagnosis) -> str:
    if d.verdict != "named":
        return SENTENCES[d.verdict]
    causes = [f"{f.effect.replace('_', ' ')} at {f.where['name']}" for f in d.findings]
    return f"The simulation lacks {' and '.join(causes)}."


def _drawn(d: Diagnosis) -> list[dict[str, Any]]:
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise ImportError(_INSTALL) from error
    p = d.pictures
    if p is None:
        return []
    shown = [
        _as_png(
            _rollouts(p),
            "Before and after",
            "A held-out recording, in windows that are simulated from a start state of their own. "
            "Shaded: 90 % interval of the extended twin, by what it misses in all such windows.",
        ),
        _as_png(
            _horizons(d, p),
            "Error against horizon",
            "Root mean square over all held-out windows and channels, in units of the noise. Bars: "
            "90 % interval of the gain.",
        ),
        _as_png(
            _missing(p),
            "The missing force",
            "What each short window asks for beyond the twin: grey as measured, blue what the "
            "causes that were found put there.",
        ),
    ]
    if d.rejected or d.findings:
        caption = (
            "By how much each candidate alone lowers the mean square error of held-out recordings."
        )
        shown.append(_as_png(_evidence(d), "The evidence for every candidate", caption))
    return shown


def _as_png(figure: Any, title: str, caption: str) -> dict[str, Any]:
    data = io.BytesIO()
    figure.savefig(data, dpi=120, format="png")
    width, height = (round(120 * inches) for inches in figure.get_size_inches())
    return {
        "title": title,
        "caption": caption,
        "data": data.getvalue(),
        "width": width,
        "height": height,
    }


def _figure(rows: int, columns: int, width: float, height: float) -> tuple[Any, np.ndarray]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False)
    for axes in panels.ravel():
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
    return figure, panels


def _rollouts(p: "Pictures") -> Any:
    """Each channel, and beside it what the simulations miss."""
    figure, panels = _figure(len(p.channels), 2, 9.0, 0.6 + 1.6 * len(p.channels))
    seen = p.replay
    for j, (name, unit) in enumerate(p.channels):
        left, right = panels[j]
        left.plot(seen.time, seen.measured[:, j], ".", color=_MEASURED, ms=3, label="measured")
        for values, colour, label in (
            (seen.before, _BEFORE, "before"),
            (seen.after, _AFTER, "after"),
        ):
            left.plot(seen.time, values[:, j], color=colour, lw=1.2, label=label)
            missed = values[:, j] - seen.measured[:, j]
            right.plot(seen.time, missed, color=colour, lw=1.2, label=label)
        for axes, centre in ((left, seen.after), (right, seen.after - seen.measured)):
            ends = [centre[:, j] + side * seen.margin[:, j] for side in (-1.0, 1.0)]
            axes.fill_between(seen.time, *ends, color=_AFTER, alpha=0.15, lw=0.0)
        right.axhline(0.0, color=_MEASURED, lw=0.6)
        left.set_ylabel(f"{name} [{unit}]", fontsize=8)
    panels[0, 0].set_title("simulated and measured", fontsize=9)
    panels[0, 1].set_title("simulated minus measured", fontsize=9)
    panels[0, 0].legend(fontsize=7, frameon=False, loc="upper right")
    for axes in panels[-1]:
        axes.set_xlabel("time [s]", fontsize=8)
    return figure


def _horizons(d: Diagnosis, p: "Pictures") -> Any:
    figure, panels = _figure(1, 1, 9.0, 3.0)
    axes = panels[0, 0]
    for errors, colour, label in zip(p.errors, (_BEFORE, _AFTER), ("before", "after"), strict=True):
        axes.plot(p.steps, errors, "o-", color=colour, ms=3, label=label)
    for gain in d.gain.values():
        ends = [gain.before * np.sqrt(max(1.0 - end, 0.0)) for end in (gain.low, gain.high)]
        axes.plot([gain.steps] * 2, ends, color=_AFTER, lw=4.0, alpha=0.3)
    axes.axhline(1.0, color=_QUIET, lw=1.0, ls="--")
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("steps from the start of a window", fontsize=8)
    axes.set_ylabel("error / noise", fontsize=8)
    axes.legend(fontsize=8, frameon=False)
    return figure


def _missing(p: "Pictures") -> Any:
    columns = 4 if p.actuators else 3
    figure, panels = _figure(len(p.joints), columns, 9.0, 0.5 + 2.2 * len(p.joints))
    explained = p.missing.force - p.left.force
    for j, (name, unit) in enumerate(p.joints):
        joint_unit = "m" if unit == "N" else "rad"
        against: list[tuple[str, np.ndarray]] = [
            (f"position [{joint_unit}]", p.missing.position[:, j]),
            (f"velocity [{joint_unit}/s]", p.missing.velocity[:, j]),
            ("time [s]", p.missing.time),
        ]
        if p.actuators:
            command = min(j, len(p.actuators) - 1)
            label = f"command [{p.actuators[command][1]}]"
            against.insert(2, (label, p.missing.command[:, command]))
        low, high = np.quantile(p.missing.force[:, j], [0.01, 0.99])
        margin = 0.2 * (high - low) + 1e-12
        for axes, (label, values) in zip(panels[j], against, strict=True):
            axes.plot(values, p.missing.force[:, j], ".", color=_QUIET, ms=3)
            if np.any(explained[:, j]):
                axes.plot(values, explained[:, j], ".", color=_AFTER, ms=3)
            axes.axhline(0.0, color=_MEASURED, lw=0.6)
            axes.set_ylim(low - margin, high + margin)
            axes.set_xlabel(label, fontsize=8)
        panels[j, 0].set_ylabel(f"{name} [{unit}]", fontsize=8)
    return figure


def _evidence(d: Diagnosis) -> Any:
    named = [(f"{f.effect} at {f.where['name']}", f.gain, _AFTER) for f in d.findings]
    others = [(r.name, r.gain, _QUIET) for r in d.rejected]
    bars = (named + others)[:25]
    figure, panels = _figure(1, 1, 9.0, 0.8 + 0.24 * len(bars))
    axes, rows = panels[0, 0], np.arange(len(bars))
    gains = [max(gain, -0.05) for _, gain, _ in bars]
    axes.barh(rows, gains, color=[colour for *_, colour in bars])
    axes.axvline(0.05, color=_BEFORE, lw=1.0, ls="--")
    axes.set_yticks(rows, [name for name, *_ in bars])
    axes.set_ylim(len(bars) - 0.4, -0.6)
    axes.set_xlim(-0.06, 1.0)
    axes.set_xlabel("held-out gain; dashed: the least that counts", fontsize=8)
    return figure
