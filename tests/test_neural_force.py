"""The learned residual: an effect like any other, that is learned, saved, and refused when bad."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from measuring import measured

from sb3_hds import effects, twins
from sb3_hds.core import Trajectories, rollout
from sb3_hds.effects import NeuralForce
from sb3_hds.errors import CalibrationError, EffectError
from sb3_hds.sysid import fit_residual


def recorded(twin, n=6, n_steps=80, noise=0.0):
    (high,) = (actuator.high for actuator in twin.actuators)
    commands = np.random.default_rng(0).uniform(-high, high, (n, n_steps, 1))
    return measured(twin, n, n_steps, noise, commands=commands)


SMALL = {"n_members": 2, "net_arch": (8,)}


def end_of(twin, params=None, n_steps=20):
    params = twin.params if params is None else params
    start = twin.initial(jax.random.key(3), params)
    actions = 0.3 * jnp.ones((n_steps, len(twin.actuators)))
    return rollout(twin, params, start, actions).obs[-1]


def test_with_no_share_it_changes_nothing(x64):
    twin = twins.make("CartPole")
    none, whole = (end_of(twin.extend(NeuralForce(share=share))) for share in (0.0, 1.0))
    np.testing.assert_allclose(none, end_of(twin), rtol=1e-9, atol=1e-9)
    assert np.abs(whole - end_of(twin)).max() > 1e-6


def test_its_gradient_in_all_that_it_depends_on_is_that_of_finite_differences(x64):
    twin = twins.make("CartPole").extend(NeuralForce(share=0.5, net_arch=(3,)))
    (key,) = {k.rpartition(".")[0] for k in twin.tensors}
    start = twin.initial(jax.random.key(3), twin.params)
    weights, n_joints = twin.tensors[f"{key}.weights"], len(twin.joints)

    def moved(change):
        """One weight of one member, position and velocity of a joint, the action, the share."""
        kernel = weights["Dense_1"]["kernel"].astype(change.dtype).at[0, 0, 0].add(change[0])
        dense = weights["Dense_1"] | {"kernel": kernel}
        params = twin.params | {f"{key}.weights": weights | {"Dense_1": dense}}
        params |= {f"{key}.share": 0.5 + change[4]}
        params |= {f"{key}.output_scale": twin.tensors[f"{key}.output_scale"] + change[5]}
        first = jnp.eye(n_joints, dtype=change.dtype)[0]
        state = start._replace(q=start.q + change[1] * first, v=start.v + change[2] * first)
        actions = (0.1 + change[3]) * jnp.ones((3, len(twin.actuators)))
        return rollout(twin, params, state, actions).obs[-1]

    slopes = jax.jit(jax.jacfwd(moved))(jnp.zeros(6))
    width, run = 1e-6, jax.jit(moved)
    for i in range(6):
        step = width * jnp.eye(6)[i]
        difference = (run(step) - run(-step)) / (2.0 * width)
        np.testing.assert_allclose(slopes[:, i], difference, rtol=1e-5, atol=1e-7)
        assert np.abs(slopes[:, i]).max() > 1e-6
    np.testing.assert_allclose(jax.jit(jax.jacrev(moved))(jnp.zeros(6)), slopes, rtol=1e-8)


def test_it_turns_with_a_hinge_and_is_bounded(x64):
    force = NeuralForce(share=1.0).fitted_to(twins.make("Pendulum"))
    own = {"share": 1.0, **force.tensors}
    q, v, u = (jnp.array([x]) for x in (0.4, 1.0, 0.5))

    once = force.forces(q, v, u, own)
    np.testing.assert_allclose(force.forces(q + 2.0 * jnp.pi, v, u, own), once, rtol=1e-12)
    assert np.abs(force.forces(q, 1e9 * v, u, own)).max() <= 3.0 and once.shape == (5, 1)
    assert force.disagreement(q, v, u, own) > 0.0


def test_caution_adds_disagreement_to_the_cost():
    twin = twins.make("Pendulum")
    bold, careful = (twin.extend(NeuralForce(share=1.0, caution=c)) for c in (0.0, 10.0))
    state, action = twin.initial(jax.random.key(0), twin.params), jnp.array([0.5])
    state = bold.infer(bold.observe(state, bold.params), bold.params)

    paid = [
        t.planning_reward(state, action, state, t.params) - t.reward(state, action, state, t.params)
        for t in (bold, careful)
    ]
    assert paid[0] == 0.0 and paid[1] < 0.0


def test_it_survives_a_file_and_its_spec_with_its_tensors(tmp_path):
    twin = twins.make("CartPole").extend(NeuralForce(n_members=3, net_arch=(5,), share=0.7))
    (effect,) = twin.effects_with_values()
    path = effect.save(tmp_path / "force")

    loaded = twins.make("CartPole").extend(NeuralForce.load(path))
    again = twins.from_spec(twin.to_spec(), effects.KNOWN).with_tensors(twin.tensors)

    assert again == twin
    for other in (loaded, again):
        np.testing.assert_array_equal(end_of(other), end_of(twin))
    np.load(path, allow_pickle=False).close()
    (other,) = twins.make("Pendulum").extend(NeuralForce()).effects_with_values()
    with pytest.raises(EffectError, match="other than those"):
        twins.make("CartPole").extend(other)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(EffectError, match="damaged"):
        NeuralForce.load(path)


def test_what_is_no_ensemble_no_file_of_one_or_too_few_data_is_refused(tmp_path):
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(EffectError, match=r"not written by NeuralForce\.save"):
        NeuralForce.load(tmp_path / "other.npz")
    with pytest.raises(EffectError, match="attach it"):
        NeuralForce().save(tmp_path / "nothing")
    with pytest.raises(EffectError, match="at least one member"):
        NeuralForce(n_members=0)
    twin = twins.make("Pendulum")
    with pytest.raises(CalibrationError, match="too few"):
        fit_residual(twin, recorded(twin, n=1, n_steps=12), window=10)


def test_it_learns_a_friction_that_the_twin_lacks():
    twin = twins.make("Pendulum")
    data = recorded(twin.extend(effects.CoulombFriction(0, tau_c=0.4)))

    found = fit_residual(twin, data, **SMALL)

    assert found.accepted and found.twin.values[f"{found.key}.share"] == 1.0
    ratio = np.sqrt(np.mean(found.error_after**2) / np.mean(found.error_before**2))
    assert ratio < 0.5
    # Against the direction of motion.
    force = found.twin.effects_with_values()[0]
    own = {"share": 1.0, **force.tensors}
    zero = jnp.zeros(1)
    ahead, back = (force.force_at(zero + 0.5, zero + v, zero, own)[0] for v in (3.0, -3.0))
    assert ahead < -0.15 and back > 0.15


@pytest.mark.parametrize("garbage", [True, False])
def test_nothing_is_learned_from_garbage_or_where_nothing_is_wrong(garbage):
    twin = twins.make("Pendulum")
    data = recorded(twin, noise=0.02)
    if garbage:
        noise = np.random.default_rng(0).standard_normal(data.obs.shape)
        data = Trajectories.from_arrays(noise, list(data.actions), dt=data.dt)

    found = fit_residual(twin, data, seed=1, **SMALL)

    assert not found.accepted and found.twin.values[f"{found.key}.share"] == 0.0
