"""Whether a size that was found is a constant: told by the slopes of single windows."""

import jax.numpy as jnp
import numpy as np
import pytest
from measuring import jumping, measured

from sb3_hds import diagnose, effects, twins
from sb3_hds.core import JointEffect, Parameter
from sb3_hds.effects.shapes import dry_friction
from sb3_hds.sysid.comparison.parameter_stability import _tested, _waves

N_WINDOWS, N_FITTED = 200, 3
SIZE = 1


class PatchyFriction(JointEffect):
    """Nothing of the catalogue: an axis that rubs where it is worn, and runs free elsewhere."""

    name = "patchy_friction"
    parameters = {"tau_c": Parameter(null=0.0, scale=1.0, unit="N")}
    explanation = "The rail is worn in places."
    source = "test"

    def torque(self, joint, memory, params):
        worn = 1.0 + jnp.cos(jnp.pi * joint.q)
        return dry_friction(joint, params["tau_c"] * worn)


def windows(rng, change=0.0, shift=0.0):
    """Of three linear parameters, all off and one changing, in standard errors of that one."""
    slopes = rng.standard_normal((N_WINDOWS, 10, N_FITTED)) * rng.gamma(1.0, 1.0, (N_WINDOWS, 1, 1))
    curvature = np.einsum("nif,nig->nfg", slopes, slopes)
    stderr = 1.0 / np.sqrt(curvature[:, SIZE, SIZE].sum())
    quantity = rng.exponential(size=N_WINDOWS)
    wrong = np.full((N_WINDOWS, N_FITTED), shift * stderr)
    wrong[:, SIZE] += change * stderr * (np.argsort(np.argsort(quantity)) / N_WINDOWS - 0.5)
    errors = rng.standard_normal((N_WINDOWS, 10)) + np.einsum("nif,nf->ni", slopes, wrong)
    return curvature, np.einsum("nif,ni->nf", slopes, errors), _waves(quantity)


def asked(rng, **wrong):
    curvature, scores, waves = windows(rng, **wrong)
    return _tested(curvature, scores, SIZE, waves)


@pytest.mark.parametrize("shift", [0.0, 5.0])
def test_a_constant_is_called_one_at_the_stated_rate_however_far_it_is_off(shift):
    rng = np.random.default_rng(0)
    p_values = np.array([asked(rng, shift=shift).p_value for _ in range(400)])
    # 400 draws at a level of 5 %: 20 are expected, more than 35 or fewer than 8 come once in 1000.
    assert 8 <= np.sum(p_values < 0.05) <= 35


def test_what_changes_is_seen_and_its_gain_is_that_of_a_fit_that_follows_it():
    rng, change = np.random.default_rng(1), 40.0
    found = [asked(rng, change=change) for _ in range(50)]

    assert max(one.p_value for one in found) < 1e-4
    # A change of d standard errors, spread evenly, adds d^2 / 24 to the cost.
    assert np.mean([one.gain for one in found]) == pytest.approx(change**2 / 24.0, rel=0.1)


def test_changes_within_practical_equivalence_or_in_a_single_window_count_as_constant():
    curvature, scores, waves = windows(np.random.default_rng(1), change=40.0)
    unminded = _tested(curvature / 100.0, scores / 100.0, SIZE, waves)
    curvature[1:, SIZE], curvature[1:, :, SIZE], scores[1:, SIZE] = 0.0, 0.0, 0.0
    alone = _tested(curvature, scores, SIZE, waves)

    assert unminded.p_value > 0.5 and np.isfinite(alone.gain) and alone.p_value > 0.05


@pytest.mark.expensive
def test_friction_that_depends_on_position_is_no_friction_of_the_catalogue():
    twin = twins.make("LinearAxis", dt=0.02)
    kinds = (effects.CoulombFriction, effects.ViscousFriction, effects.ConstantForce)
    rubbing = {"commands": jumping(10), "n": 10, "noise": 1e-3}

    hidden = (PatchyFriction(0, tau_c=0.5), effects.CoulombFriction(0, tau_c=0.5))
    data = [measured(twin.extend(effect), **rubbing) for effect in hidden]
    patchy, even = (diagnose(twin, each, effects=kinds) for each in data)

    assert patchy.verdict == "unknown" and not patchy.findings
    assert "coulomb_friction.axis comes nearest" in patchy.unexplained
    assert "goes with position" in patchy.unexplained
    assert [f.effect for f in even.findings] == ["coulomb_friction"] and not even.unexplained
