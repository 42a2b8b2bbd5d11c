"""What a diagnosis says, in print, as plain data and as a page."""

import dataclasses
import html
import json
import math
import re
import shutil
import subprocess
from itertools import pairwise

import numpy as np
import pytest
from measuring import measured

from sb3_hds import diagnose, effects, twins
from sb3_hds.errors import ParameterError
from sb3_hds.sysid import plots, telling
from sb3_hds.sysid.diagnosis import SENTENCES, Rejected

TWIN = twins.make("PendulumReal")
KINDS = (effects.CoulombFriction, effects.ViscousFriction, effects.Backlash)


@pytest.fixture(scope="module")
def rubbing():
    data = measured(TWIN.extend(effects.CoulombFriction(0, tau_c=0.1)), 12, 120, noise=0.01)
    return diagnose(TWIN, data, effects=KINDS, budget="quick", progress=False)


@pytest.fixture(scope="module")
def crowded(rubbing):
    """As many candidates as a machine with two joints has, and long sentences."""
    name = "directional_viscous_friction.pendulum"
    more = [Rejected(f"{name}{i}", 0.7 / (i + 1), 0.01, "others gain more") for i in range(66)]
    (first,) = rubbing.findings
    sizes = {
        f"{name}_{side}": dataclasses.replace(
            size, unit="N m s2/rad2", stderr=1.234e-05, low=-1.234e-05, added_to=0.05
        )
        for name, size in first.parameters.items()
        for side in ("positive", "negative")
    }
    alike = dataclasses.replace(
        first, alternatives=(f"{name}0", f"{name}1"), parameters=first.parameters | sizes
    )
    return dataclasses.replace(
        rubbing,
        verdict="ambiguous",
        findings=(alike,),
        rejected=(*more, Rejected("sign_flip.cos", -5000.0, 1.0, "gains too little")),
        unexplained="a force at pendulum goes with position and time; 12% of it is predictable.",
    )


POLICY = {
    "simulations": {
        "believed": {"mean": -330.0, "low": -350.0, "high": -310.0},
        "extended": {"mean": -210.0, "low": -215.0, "high": -200.0},
        "true": {"mean": -200.0, "low": -205.0, "high": -190.0},
    },
    "gain": {"mean": 120.0, "low": 100.0, "high": 140.0},
    "share_of_ceiling": 0.92,
    "runs": 2,
    "episodes": 3,
    "returns": {
        "believed": [[-340.0, -330.0, -320.0]] * 2,
        "extended": [[-215.0, -210.0, -205.0]] * 2,
        "true": [[-205.0, -200.0, -195.0]] * 2,
    },
}


# --- in print


@pytest.mark.parametrize("which", ["rubbing", "crowded"])
def test_a_diagnosis_prints_itself_in_80_columns(which, request):
    text = str(request.getfixturevalue(which))
    assert max(map(len, text.splitlines())) <= 80
    assert "coulomb_friction at joint hinge" in text and "N m" in text
    assert "Not accepted" in text


def test_every_rejected_candidate_is_printed_whole_and_with_its_reason(crowded):
    text = str(crowded)
    by_reason = {}
    for line in text.partition("Not accepted")[2].splitlines()[1:]:
        if line.startswith("  (gain"):
            break
        by_reason.setdefault("last", []).append(line)
    told = " ".join(" ".join(by_reason["last"]).split())

    assert [
        r.name for r in crowded.rejected if f"{r.name} " not in f"{told} ".replace(",", "")
    ] == []
    assert told.count("others gain more") == 5 + 1 and "gains too little: sign_flip.cos" in told
    assert "%" not in told.partition("gains too little")[2]


REASONS = ("UNCERTAIN", "SMALL", "CHANCE", "NO_CONSTANT", "NAMELESS", "ANOTHER")


@pytest.mark.parametrize("why", [getattr(telling, name) for name in REASONS])
def test_a_reason_to_turn_something_down_is_printed_as_a_whole(rubbing, why):
    rejected = (Rejected("directional_viscous_friction.hinge_velocity", -50.0, math.nan, why),)
    text = str(dataclasses.replace(rubbing, rejected=rejected))
    lines = text.splitlines()

    assert any(line.endswith(why) for line in lines) and max(map(len, lines)) <= 80
    assert "far worse" in text and "nan" not in text


def test_print_and_page_say_the_same(crowded, tmp_path):
    """Evidence, sizes, alternatives, errors by horizon, and a reason for every candidate."""
    text = " ".join(str(crowded).split())
    page = crowded.to_html(tmp_path / "report.html", POLICY).read_text()
    page = html.unescape(re.sub("<[^>]*>", " ", page.replace("<wbr>", ""))).replace("\xa0", " ")
    page = " ".join(page.split())
    (one,) = crowded.findings
    size = one.parameters["tau_c"]

    for said in (
        crowded.sentence,
        f"It lowers the mean square error of held-out recordings by {one.gain:.0%} (p = ",
        f"{size.estimate:.4g} N m",
        f"{size.low:.4g} to {size.high:.4g}",
        "The data cannot tell it from: directional_viscous_friction.pendulum0, ",
        f"What was found explains {crowded.explained:.0%} of the force that is missing",
        crowded.unexplained,
        "Held-out error by steps ahead, in units of what the best fit leaves:",
        *(f"{gain.low:.0%} to {gain.high:.0%}" for gain in crowded.gain.values()),
        "gain: by how much the candidate lowers the mean square error of held-out recordings; p:",
        crowded.made_with,
    ):
        assert said in text and said in page, said
    for rejected in crowded.rejected:
        assert f"{rejected.name} " in page and rejected.why in page
    assert page.count("others gain more") == 66


def test_what_was_refitted_on_the_way_is_said(rubbing):
    heavier = rubbing.twin.with_parameters(mass=1.2)
    assert "Refitted" not in str(rubbing)
    assert "Refitted: mass 1 -> 1.2 kg" in str(dataclasses.replace(rubbing, twin=heavier))


def test_what_is_added_to_the_twins_own_says_so(rubbing, tmp_path):
    (first,) = rubbing.findings
    added = dataclasses.replace(first.parameters["tau_c"], added_to=0.05)
    other = dataclasses.replace(first, parameters={"tau_c": added})
    found = dataclasses.replace(rubbing, findings=(other,))

    page = found.to_html(tmp_path / "report.html").read_text().replace("\xa0", " ")
    for told in (" ".join(str(found).split()), page.replace("&#39;", "'")):
        assert f"{added.estimate:.4g} N m, added to the twin's own 0.05 N m" in told


def test_a_report_is_a_page(rubbing, tmp_path):
    with pytest.raises(
        ParameterError, match=r"an HTML page: name it .*r\.html in place of .*r\.pdf"
    ):
        rubbing.to_html(tmp_path / "r.pdf")
    assert not list(tmp_path.iterdir())


def test_who_is_told_that_nothing_is_wrong_is_told_what_would_have_shown(rubbing):
    nothing = dataclasses.replace(rubbing, verdict="none", findings=())
    size = rubbing.detectable["coulomb_friction.hinge"]["tau_c"]

    assert f"  coulomb_friction.hinge: tau_c {size:.2g} N m" in str(nothing).replace("\xa0", " ")
    many = {f"coulomb_friction.hinge{i}": {"tau_c": 0.1} for i in range(15)}
    crowd = dataclasses.replace(nothing, detectable=many | {"sign_flip.hinge": {"flipped": np.inf}})
    assert "and 3 more, in the report" in str(crowd)


def changed(diagnosis, where, names, **finding):
    """The same with a finding elsewhere, whose parameters have these full names."""
    (first,) = diagnosis.findings
    size = first.parameters["tau_c"]
    parameters = {name.rpartition(".")[2]: dataclasses.replace(size, name=name) for name in names}
    other = dataclasses.replace(first, where=where, parameters=parameters, **finding)
    return dataclasses.replace(diagnosis, findings=(other,))


def test_the_verdict_is_one_sentence(rubbing, crowded):
    own = {"slot": "parameter", "index": 1, "name": "mass"}
    hinge = rubbing.findings[0].where
    heavier = changed(rubbing, own, ["mass"], effect="parameter.mass")
    damped = changed(rubbing, hinge, ["damping"], effect="viscous_friction")
    both = dataclasses.replace(rubbing, findings=(*rubbing.findings, *heavier.findings))

    assert rubbing.sentence == "The simulation lacks Coulomb friction at hinge."
    assert heavier.sentence == "The simulation is wrong about mass."
    # The twin has damping of its own: there may be less.
    assert damped.sentence == "The simulation is wrong about viscous friction at hinge."
    assert both.sentence == (
        "The simulation lacks Coulomb friction at hinge and is wrong about mass."
    )
    assert crowded.sentence == (
        "The simulation is wrong about Coulomb friction at hinge or directional viscous friction "
        "at pendulum0 or directional viscous friction at pendulum1: the data cannot tell which."
    )
    first, second = both.findings
    doubted = (first, dataclasses.replace(second, alternatives=("torque_gain.torque",)))
    assert dataclasses.replace(both, findings=doubted).sentence == (
        "The simulation lacks Coulomb friction at hinge and is wrong about either mass or torque "
        "gain at torque."
    )
    nothing = dataclasses.replace(rubbing, verdict="none", findings=())
    assert nothing.sentence == SENTENCES["none"]
    assert "parameter.mass\n" in str(heavier) and "at parameter" not in str(heavier)


# --- plain data


def test_a_diagnosis_is_plain_data_with_the_parameters_of_the_extended_twin(rubbing):
    plain = rubbing.to_dict()

    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
    assert set(plain) >= {
        "verdict",
        "findings",
        "unexplained",
        "gain",
        "explained",
        "detectable",
        "rejected",
        "caveats",
        "twin",
        "params",
        "data_hash",
        "versions",
        "seed",
    }
    assert plain["params"] == rubbing.twin.values
    assert plain["params"]["coulomb_friction.hinge.tau_c"] == pytest.approx(0.1, rel=0.1)


def test_what_is_not_finite_or_of_numpy_is_plain_data_too(rubbing):
    odd = dataclasses.replace(
        rubbing,
        detectable={"backlash.hinge": {"gap": math.inf}},
        explained=np.float32("nan"),
        seed=np.int64(3),
        rejected=(Rejected("backlash.hinge", -math.inf, math.nan, "gains too little"),),
    )

    plain = odd.to_dict()

    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
    assert plain["detectable"] == {"backlash.hinge": {"gap": None}}
    assert plain["explained"] is None and plain["seed"] == 3
    assert plain["rejected"][0]["gain"] is None and plain["rejected"][0]["p_value"] is None


# --- as a page


def test_the_report_is_one_page_that_needs_no_network(rubbing, tmp_path):
    path = rubbing.to_html(tmp_path / "report.html")

    text = path.read_text()
    assert "lacks Coulomb friction at hinge" in text
    # Four pictures, each for wide and for narrow pages.
    assert text.count("data:image/png;base64,") == 2 * 4
    written = re.sub('base64,[^"]*', "", text)
    assert "http" not in written and "<script src" not in written and "<link" not in written
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


def test_a_report_without_a_folder_is_refused_at_once(rubbing, tmp_path):
    with pytest.raises(FileNotFoundError, match="cannot be written: there is no such folder"):
        rubbing.to_html(tmp_path / "nowhere" / "report.html")


def test_the_report_says_sizes_with_units_and_errors(rubbing, tmp_path):
    text = rubbing.to_html(tmp_path / "report.html").read_text().replace("\N{NO-BREAK SPACE}", " ")
    text = text.replace(' class="short"', "")
    size = rubbing.findings[0].parameters["tau_c"]

    for shown in (
        f"<td>{size.estimate:.4g} N m</td><td>{size.stderr:.2g}</td>"
        f"<td>{size.low:.4g} to {size.high:.4g}</td>",
        "<td>mass</td><td>1 kg</td><td>1 kg</td>",
        f"<td>coulomb_<wbr>friction.hinge.tau_<wbr>c</td><td></td><td>{size.estimate:.4g} N m</td>",
        f"tau_<wbr>c {rubbing.detectable['coulomb_friction.hinge']['tau_c']:.2g} N m</td>",
        f"b {rubbing.detectable['viscous_friction.hinge']['b']:.2g} N m s/rad</td>",
    ):
        assert shown in text, shown


def test_data_that_say_nothing_make_a_page_too(rubbing, tmp_path):
    refused = dataclasses.replace(
        rubbing,
        verdict="not_identifiable",
        twin=TWIN,
        findings=(),
        gain={},
        explained=0.0,
        detectable={},
        rejected=(),
        caveats=("The system stands still.",),
        pictures=None,
    )
    text = refused.to_html(tmp_path / "report.html").read_text()
    assert "The system stands still." in text and "<img" not in text


def test_its_pictures_are_files_too(rubbing, tmp_path):
    saved = rubbing.save_pictures(tmp_path / "pictures")
    assert [path.name for path in saved] == [
        "before_and_after.png",
        "error_against_horizon.png",
        "the_missing_force.png",
        "the_evidence_for_every_candidate.png",
    ]
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in saved)


@pytest.mark.parametrize("narrow", [False, True])
def test_every_candidate_has_its_bar(crowded, narrow):
    figure = plots.plot_evidence(crowded, narrow)
    (axes,) = figure.axes
    figure.draw_without_rendering()

    names = [label.get_text() for label in axes.get_yticklabels()]
    assert names == ["coulomb_friction.hinge", *(r.name for r in crowded.rejected)]
    assert len(axes.patches) == len(names)
    boxes = [label.get_window_extent() for label in axes.get_yticklabels()]
    assert all(below.y1 <= above.y0 for above, below in pairwise(boxes))
    assert all(box.x0 >= 0.0 for box in boxes)


# --- in a browser

LOOK = """
<script>addEventListener("load", () => {
  const page = document.querySelector("iframe").contentDocument, root = page.documentElement;
  const wide = [...page.querySelectorAll("body *")].filter(
    e => e.getBoundingClientRect().right > root.clientWidth + 1);
  document.title = JSON.stringify({
    visible: page.defaultView.innerWidth, laid_out: root.scrollWidth, shown: root.clientWidth,
    overrun: [...page.querySelectorAll(".finding *")].filter(e => e.getBoundingClientRect().right
      > e.closest(".finding").getBoundingClientRect().right + 1).map(e => e.outerHTML.slice(0, 80)),
    sticking_out: wide.map(e => e.tagName + " " + e.textContent.slice(0, 40)),
    pictures: [...page.images].map(i => i.complete ? i.naturalWidth / i.clientWidth : 0)});
})</script>"""


def in_chromium(page, width, folder):
    """
    A page in a frame of that many pixels: by itself, Chromium shows nothing narrower than 500.

    :return: what is laid out, and what the console says
    """
    frame = f"width:{width}px;height:900px;border:0"
    host = folder / f"host{width}.html"
    host.write_text(
        f"<!DOCTYPE html><title></title>{LOOK}"
        f'<iframe style="{frame}" srcdoc="{html.escape(page)}"></iframe>'
    )
    browser = subprocess.run(
        [
            "chromium",
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--enable-logging=stderr",
            "--window-size=1500,1000",
            "--dump-dom",
            host.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=120,
    )
    title = browser.stdout.partition("<title>")[2].partition("</title>")[0]
    console = [line for line in browser.stderr.splitlines() if "CONSOLE" in line]
    return json.loads(html.unescape(title)), console


needs_chromium = pytest.mark.skipif(
    not shutil.which("chromium"), reason="chromium is not installed (Debian: apt install chromium)"
)


@needs_chromium
@pytest.mark.parametrize("width", [400, 1400])
@pytest.mark.parametrize("which", ["rubbing", "crowded"])
def test_the_report_fits_a_browser(which, width, request, tmp_path):
    diagnosis = request.getfixturevalue(which)
    page = diagnosis.to_html(tmp_path / "report.html", POLICY).read_text()

    found, console = in_chromium(page, width, tmp_path)

    assert found["visible"] == width
    assert found["laid_out"] <= found["shown"] and not found["sticking_out"]
    assert not found["overrun"]
    assert len(found["pictures"]) == 5
    # A picture has at least as many pixels as it is shown with.
    assert all(ratio >= 1.0 for ratio in found["pictures"])
    assert console == []


@needs_chromium
def test_what_is_wrong_with_a_page_is_seen(rubbing, tmp_path):
    page = rubbing.to_html(tmp_path / "report.html").read_text()
    bad = page.replace("data:image/png;base64,iVBOR", "data:image/png;base64,oops").replace(
        "</body>", '<p style="width:2000px">x</p><script>console.error("boo")</script></body>'
    )

    found, console = in_chromium(bad, 400, tmp_path)

    assert found["laid_out"] > found["shown"] and found["sticking_out"]
    assert 0 in found["pictures"]
    assert len(console) == 1 and "boo" in console[0]


@needs_chromium
@pytest.mark.skipif(not shutil.which("pdftotext"), reason="pdftotext is not installed")
def test_a_printed_report_has_no_heading_without_its_picture(crowded, tmp_path):
    page, paper = crowded.to_html(tmp_path / "report.html", POLICY), tmp_path / "report.pdf"
    subprocess.run(
        [
            "chromium",
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--no-pdf-header-footer",
            f"--print-to-pdf={paper}",
            page.as_uri(),
        ],
        capture_output=True,
        check=True,
        timeout=120,
    )
    text = subprocess.run(["pdftotext", "-layout", paper, "-"], capture_output=True, text=True)
    sheets = [sheet.strip() for sheet in text.stdout.split("\f") if sheet.strip()]

    for title, caption in (
        ("Before and after", "A held-out recording"),
        ("Error against horizon", "Root mean square"),
        ("The missing force", "What each short window"),
        ("The evidence for every candidate", "By how much each candidate"),
        ("What it buys", "Dots: runs"),
    ):
        (sheet,) = [sheet for sheet in sheets if title in sheet]
        assert caption in sheet, title
    assert sum("Parameters of the extended twin" in sheet for sheet in sheets) == 1
