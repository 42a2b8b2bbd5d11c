"""What a diagnosis says, in print, as plain data and as a page."""

import dataclasses
import html
import json
import math
import re

import numpy as np
import pytest
from browser import in_chromium, needs_chromium
from measuring import measured

from sb3_hds import diagnose, effects, twins
from sb3_hds.errors import ParameterError
from sb3_hds.sysid import telling
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


REASONS = ("UNCERTAIN", "SMALL", "CHANCE", "NO_CONSTANT", "NAMELESS", "ANOTHER")


@pytest.mark.parametrize("why", [getattr(telling, name) for name in REASONS])
def test_a_reason_to_turn_something_down_is_printed_as_a_whole(rubbing, why):
    rejected = (Rejected("directional_viscous_friction.hinge_velocity", -50.0, math.nan, why),)
    lines = str(dataclasses.replace(rubbing, rejected=rejected)).splitlines()

    assert any(line.endswith(why) for line in lines) and max(map(len, lines)) <= 80
    assert any("far worse" in line for line in lines)


def test_print_and_page_say_the_same_and_print_has_80_columns(crowded, tmp_path):
    """Evidence, sizes, alternatives, errors by horizon, and a reason for every candidate."""
    text = " ".join(str(crowded).split())
    page = crowded.to_html(tmp_path / "report.html", POLICY).read_text()
    page = html.unescape(re.sub("<[^>]*>", " ", page.replace("<wbr>", ""))).replace("\xa0", " ")
    page = " ".join(page.split())
    (one,) = crowded.findings
    size = one.parameters["tau_c"]

    for said in (
        crowded.sentence,
        f"error of held-out recordings by {one.gain:.0%} (p = ",
        f"{size.estimate:.4g} N m",
        f"{size.low:.4g} to {size.high:.4g}",
        "The data cannot tell it from: directional_viscous_friction.pendulum0, ",
        f"What was found explains {crowded.explained:.0%} of the force that is missing",
        crowded.unexplained,
        *(f"{gain.low:.0%} to {gain.high:.0%}" for gain in crowded.gain.values()),
        crowded.made_with,
    ):
        assert said in text and said in page, said
    for rejected in crowded.rejected:
        assert f"{rejected.name} " in page and rejected.why in page
        assert re.search(rf"{rejected.name}[ ,]", text + " "), rejected.name
    assert page.count("others gain more") == 66
    assert max(map(len, str(crowded).splitlines())) <= 80
    nothing = dataclasses.replace(crowded, verdict="none", findings=())
    limit = crowded.detectable["coulomb_friction.hinge"]["tau_c"]
    assert f"coulomb_friction.hinge: tau_c {limit:.2g} N m" in str(nothing).replace("\xa0", " ")


def test_what_is_added_to_the_twins_own_and_what_was_refitted_is_said(rubbing, tmp_path):
    (first,) = rubbing.findings
    added = dataclasses.replace(first.parameters["tau_c"], added_to=0.05)
    other = dataclasses.replace(first, parameters={"tau_c": added})
    heavier = rubbing.twin.with_parameters(mass=1.2)
    found = dataclasses.replace(rubbing, findings=(other,), twin=heavier)

    page = found.to_html(tmp_path / "report.html").read_text().replace("\xa0", " ")
    for told in (" ".join(str(found).split()), page.replace("&#39;", "'")):
        assert f"{added.estimate:.4g} N m, added to the twin's own 0.05 N m" in told
    assert "Refitted: mass 1 -> 1.2 kg" in str(found) and "Refitted" not in str(rubbing)


def changed(diagnosis, where, names, **finding):
    """The same with a finding elsewhere, whose parameters have these full names."""
    (first,) = diagnosis.findings
    size = first.parameters["tau_c"]
    parameters = {name.rpartition(".")[2]: dataclasses.replace(size, name=name) for name in names}
    other = dataclasses.replace(first, where=where, parameters=parameters, **finding)
    return dataclasses.replace(diagnosis, findings=(other,))


def test_the_verdict_is_one_sentence(rubbing, crowded):
    own = {"slot": "parameter", "index": 1, "name": "mass"}
    heavier = changed(rubbing, own, ["mass"], effect="parameter.mass")
    damped = changed(rubbing, rubbing.findings[0].where, ["damping"], effect="viscous_friction")
    both = dataclasses.replace(rubbing, findings=(*rubbing.findings, *heavier.findings))
    first, second = both.findings
    doubted = (first, dataclasses.replace(second, alternatives=("torque_gain.torque",)))

    for found, sentence in (
        (rubbing, "lacks Coulomb friction at hinge."),
        (heavier, "is wrong about mass."),
        # The twin has damping of its own: there may be less.
        (damped, "is wrong about viscous friction at hinge."),
        (both, "lacks Coulomb friction at hinge and is wrong about mass."),
        (
            dataclasses.replace(both, findings=doubted),
            "lacks Coulomb friction at hinge and is wrong about either mass or torque gain at "
            "torque.",
        ),
        (
            crowded,
            "is wrong about Coulomb friction at hinge or directional viscous friction at pendulum0 "
            "or directional viscous friction at pendulum1: the data cannot tell which.",
        ),
    ):
        assert found.sentence == f"The simulation {sentence}"
    assert dataclasses.replace(rubbing, verdict="none").sentence == SENTENCES["none"]


# --- plain data


def test_a_diagnosis_is_plain_data_with_the_parameters_of_the_extended_twin(rubbing):
    plain = rubbing.to_dict()

    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
    assert set(plain) >= {"verdict", "findings", "unexplained", "gain", "explained", "rejected"}
    assert set(plain) >= {"detectable", "caveats", "twin", "data_hash", "versions", "seed"}
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


def test_a_report_is_a_page_in_a_folder(rubbing, tmp_path):
    with pytest.raises(ParameterError, match=r"r\.html in place of"):
        rubbing.to_html(tmp_path / "r.pdf")
    with pytest.raises(FileNotFoundError, match="no such folder"):
        rubbing.to_html(tmp_path / "nowhere" / "report.html")
    assert not list(tmp_path.iterdir())


def test_data_that_say_nothing_make_a_page_too(rubbing, tmp_path):
    nothing = {"findings": (), "gain": {}, "explained": 0.0, "detectable": {}, "rejected": ()}
    said = {"verdict": "not_identifiable", "caveats": ("The system stands still.",)}
    refused = dataclasses.replace(rubbing, twin=TWIN, pictures=None, **nothing, **said)
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


# --- in a browser

LOOK = """(page, done) => {
  const root = page.documentElement;
  const over = (e, limit) => e.getBoundingClientRect().right > limit + 1;
  done({
    laid_out: root.scrollWidth, shown: root.clientWidth,
    overrun: [...page.querySelectorAll(".finding *")].filter(
      e => over(e, e.closest(".finding").getBoundingClientRect().right)).length,
    pictures: [...page.images].map(i => i.complete ? i.naturalWidth / i.clientWidth : 0)});
}"""


@needs_chromium
@pytest.mark.parametrize("width", [400, 1400])
def test_the_report_fits_a_browser(width, crowded, tmp_path):
    page = crowded.to_html(tmp_path / "report.html", POLICY).read_text()

    found, console = in_chromium(page, LOOK, width, tmp_path)

    assert found["laid_out"] <= found["shown"] <= width and not found["overrun"]
    # A picture has at least as many pixels as it is shown with.
    assert len(found["pictures"]) == 5 and min(found["pictures"]) >= 1.0
    assert console == []
