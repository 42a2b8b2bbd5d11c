"""What a diagnosis says, in print, as plain data and as a page."""

import dataclasses
import json
import math

import numpy as np
import pytest
from measuring import measured

from sb3_hds import diagnose, effects, twins
from sb3_hds.sysid.diagnosis import Rejected

TWIN = twins.make("PendulumReal")
KINDS = (effects.CoulombFriction, effects.ViscousFriction, effects.Backlash)


@pytest.fixture(scope="module")
def rubbing():
    data = measured(TWIN.extend(effects.CoulombFriction(0, tau_c=0.1)), 12, 120, noise=0.01)
    return diagnose(TWIN, data, effects=KINDS, budget="quick", progress=False)


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
