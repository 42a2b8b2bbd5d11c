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
from sb3_hds.sysid.diagnosis import findings as telling
from sb3_hds.sysid.equation.members import FrictionCurve
from sb3_hds.sysid.reporting import figures as plots
from sb3_hds.sysid.reporting.diagnosis import SENTENCES
from sb3_hds.sysid.reporting.finding import Rejected
from sb3_hds.sysid.reporting.printed import rows_of

TWIN = twins.make("PendulumReal")
KINDS = (effects.CoulombFriction, effects.ViscousFriction)


@pytest.fixture(scope="module")
def rubbing():
    data = measured(TWIN.extend(effects.CoulombFriction(0, tau_c=0.1)), 8, 80, noise=0.01)
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
    sizes = first.parameters | sizes
    alike = dataclasses.replace(first, alternatives=(f"{name}0", f"{name}1"), parameters=sizes)
    return dataclasses.replace(
        rubbing,
        twin=rubbing.twin.with_parameters(mass=1.2),
        verdict="ambiguous",
        findings=(alike,),
        rejected=(*more, Rejected("sign_flip.cos", -5000.0, 1.0, "gains too little")),
        unexplained="a force at pendulum goes with position and time; 12% of it is predictable.",
    )


MEANS = {"believed": -330.0, "extended": -210.0, "true": -200.0}
POLICY = {
    "simulations": {k: {"mean": m, "low": m - 5.0, "high": m + 10.0} for k, m in MEANS.items()},
    "gain": {"mean": 120.0, "low": 100.0, "high": 140.0},
    "share_of_ceiling": 0.92,
    "runs": 2,
    "episodes": 3,
    "returns": {k: [[m - 10.0, m, m + 10.0]] * 2 for k, m in MEANS.items()},
}


@pytest.fixture(scope="module")
def page(crowded, tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    path = crowded.to_html(folder / "report.html", POLICY)
    assert list(folder.iterdir()) == [path]
    return path.read_text()


def test_every_reason_for_a_rejection_is_printed_completely(rubbing):
    reasons = ("UNCERTAIN", "SMALL", "CHANCE", "NO_CONSTANT", "NAMELESS", "ANOTHER")
    for why in (getattr(telling, name) for name in reasons):
        rejected = (Rejected("directional_viscous_friction.hinge_velocity", -50.0, math.nan, why),)
        lines = str(dataclasses.replace(rubbing, rejected=rejected)).splitlines()

        assert any(line.endswith(why) for line in lines) and max(map(len, lines)) <= 80
        assert any("far worse" in line for line in lines)


def test_print_and_page_say_the_same_and_print_has_80_columns(crowded, page):
    """Evidence, sizes, alternatives, errors by horizon, and a reason for every candidate."""
    text = " ".join(str(crowded).split())
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
        "added to the twin's own 0.05 N m s2/rad2",
        *(f"{gain.low:.0%} to {gain.high:.0%}" for gain in crowded.gain.values()),
        crowded.made_with,
    ):
        assert said in text and said in page, said
    for rejected in crowded.rejected:
        assert f"{rejected.name} " in page and rejected.why in page
        assert re.search(rf"{rejected.name}[ ,]", text + " "), rejected.name
    assert page.count("others gain more") == 66 and "Refitted: mass 1 -> 1.2 kg" in text
    assert max(map(len, str(crowded).splitlines())) <= 80
    nothing = dataclasses.replace(crowded, verdict="none", findings=())
    limit = crowded.detectable["coulomb_friction.hinge"]["tau_c"]
    assert f"coulomb_friction.hinge: tau_c {limit:.2g} N m" in str(nothing).replace("\xa0", " ")


@pytest.fixture(scope="module")
def many(rubbing):
    """Viscous and Coulomb friction and an offset at both joints of an arm, told in a table."""
    arm = twins.make("DoublePendulum")
    (first,) = rubbing.findings
    size = first.parameters["tau_c"]

    def at(index, effect, name, others=()):
        where = {"slot": "joint", "index": index, "name": arm.joints[index].name}
        own = {name: dataclasses.replace(size, name=f"{effect}.{where['name']}.{name}")}
        return dataclasses.replace(
            first, effect=effect, where=where, parameters=own, alternatives=others, share=0.25
        )

    causes = {"viscous_friction": "b", "coulomb_friction": "tau_c", "constant_force": "tau_0"}
    found = [at(1 - index, *cause) for cause in causes.items() for index in range(2)]
    found[2] = dataclasses.replace(found[2], alternatives=("stiffness.elbow",))
    curve = FrictionCurve(0, *(np.linspace(-1.0, 1.0, 40) for _ in range(3)))
    pictures = rubbing.pictures._replace(friction=(curve,))
    return dataclasses.replace(
        rubbing, findings=tuple(found), believed=arm, twin=arm, pictures=pictures
    )


def test_many_causes_are_a_table_by_joint_and_friction_is_drawn(many):
    names = [joint.name for joint in many.believed.joints]
    rows = rows_of(many.findings, names)
    assert [row[0] for row in rows] == [names[0]] * 3 + [names[1]] * 3
    assert [row[1] for row in rows[:3]] == [
        "viscous friction",
        "Coulomb friction",
        "constant force",
    ]
    assert all(row[-1] == "25%" for row in rows)
    text = str(many)
    assert text.startswith("named: Both joints have viscous and Coulomb friction")
    assert "Refitted" not in text and text.count("cannot tell") == 1
    assert many.sentence.endswith("from stiffness at elbow.") and many.headline in many.sentence

    (panel,) = plots.plot_friction(many.pictures).axes
    dots, line, _ = panel.lines
    assert panel.get_title() == "hinge" and len(dots.get_xdata()) == len(line.get_xdata()) == 40


def test_a_model_that_runs_away_leaves_the_measurements_in_sight(rubbing):
    seen = rubbing.pictures.replay
    away = rubbing.pictures._replace(replay=seen._replace(before=1e6 * seen.before))
    for j, (left, right) in enumerate(np.reshape(plots.plot_rollouts(away).axes, (-1, 2))):
        span = np.ptp(seen.measured[np.isfinite(seen.measured[:, j]), j])
        assert np.ptp(left.get_ylim()) <= 2.5 * span and np.ptp(right.get_ylim()) <= 2.5 * span


def test_the_verdict_is_one_sentence(rubbing, crowded):
    (first,) = rubbing.findings
    size = first.parameters["tau_c"]

    def about(effect, name, where=first.where, **more):
        parameters = {name: dataclasses.replace(size, name=name)}
        return dataclasses.replace(first, effect=effect, where=where, parameters=parameters, **more)

    own = {"slot": "parameter", "index": 1, "name": "mass"}
    heavier = about("parameter.mass", "mass", own)
    doubted = about("parameter.mass", "mass", own, alternatives=("torque_gain.torque",))
    for findings, sentence in (
        ([first], "lacks Coulomb friction at hinge."),
        # The twin has damping of its own: there may be less.
        ([about("viscous_friction", "damping")], "is wrong about viscous friction at hinge."),
        ([first, heavier], "lacks Coulomb friction at hinge and is wrong about mass."),
        (
            [first, doubted],
            "lacks Coulomb friction at hinge and is wrong about either mass or torque gain at "
            "torque.",
        ),
        (
            crowded.findings,
            "is wrong about Coulomb friction at hinge or directional viscous friction at pendulum0 "
            "or directional viscous friction at pendulum1: the data cannot tell which.",
        ),
    ):
        verdict = "ambiguous" if findings is crowded.findings else "named"
        found = dataclasses.replace(rubbing, verdict=verdict, findings=tuple(findings))
        assert found.sentence == f"The simulation {sentence}"
    assert dataclasses.replace(rubbing, verdict="none").sentence == SENTENCES["none"]


def test_a_diagnosis_is_plain_data_also_of_what_is_not_finite_or_of_numpy(rubbing):
    odd = dataclasses.replace(
        rubbing,
        detectable={"backlash.hinge": {"gap": math.inf}},
        explained=np.float32("nan"),
        seed=np.int64(3),
        rejected=(Rejected("backlash.hinge", -math.inf, math.nan, "gains too little"),),
    )

    plain = odd.to_dict()

    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
    assert plain["detectable"] == {"backlash.hinge": {"gap": None}} and plain["seed"] == 3
    assert plain["explained"] is plain["rejected"][0]["gain"] is None
    assert plain["params"] == rubbing.twin.values
    assert plain["params"]["coulomb_friction.hinge.tau_c"] == pytest.approx(0.1, rel=0.1)


def test_the_report_needs_no_network_and_its_pictures_are_files_too(rubbing, page, tmp_path):
    saved = rubbing.save_pictures(tmp_path)

    assert all(path.read_bytes().startswith(b"\x89PNG") for path in saved)
    # Each for wide and for narrow pages, and the gain in policy.
    assert len(saved) == 5 and page.count("data:image/png;base64,") == 2 * 6
    written = re.sub('base64,[^"]*', "", page)
    assert "http" not in written and "<script src" not in written and "<link" not in written
    with pytest.raises(ParameterError, match=r"r\.html in place of"):
        rubbing.to_html(tmp_path / "r.pdf")


def test_unidentifiable_data_make_a_page_too(rubbing, tmp_path):
    nothing = {"findings": (), "gain": {}, "explained": 0.0, "detectable": {}, "rejected": ()}
    said = {"verdict": "not_identifiable", "caveats": ("The system stands still.",)}
    refused = dataclasses.replace(rubbing, twin=TWIN, pictures=None, **nothing, **said)
    text = refused.to_html(tmp_path / "report.html").read_text()
    assert "The system stands still." in text and "<img" not in text


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
def test_the_report_fits_a_narrow_browser(page, many, rubbing, tmp_path):
    found, console = in_chromium(page, LOOK, 400, tmp_path)
    assert found["laid_out"] <= found["shown"] <= 400 and not found["overrun"]
    table = dataclasses.replace(many, believed=rubbing.believed, twin=rubbing.twin)
    table = table.to_html(tmp_path / "many.html").read_text()
    tabled, _ = in_chromium(table, LOOK, 400, tmp_path)
    assert tabled["laid_out"] <= tabled["shown"] <= 400
    # A picture has at least as many pixels as it is shown with.
    assert len(found["pictures"]) == 6 and min(found["pictures"]) >= 1.0 and console == []
