"""Layers that make actions smooth and safe: what they do to commands, observations and info."""

import gymnasium
import jaxtyping
import numpy as np
import pytest
from gymnasium import spaces
from moving_joints import DT, MovingJoints, distances, walls
from scipy import optimize, signal
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_hds.errors import ParameterError, SafetyError
from sb3_hds.wrappers import (
    ActionDelay,
    ActionRateLimit,
    ActionScale,
    ActionShield,
    ContinuityCost,
    CPGPrior,
    HistoryObservation,
    JointLimitBarrier,
    LowPassAction,
    Phase,
    SharedControlTemplate,
)
from sb3_hds.wrappers.projection import nearest

PHASES = [
    {
        "name": "right",
        "mapping": [[5.0], [0.0]],
        "transitions": [{"to": "up", "when": {"channel": 0, "above": 0.5}}],
    },
    {"name": "up", "mapping": [[0.0], [5.0]], "constraints": ([[0.0, 1.0]], [2.0])},
]

#: every layer around two joints that move as told, by its name
#: every layer around two joints that move as told, by its name; contract: ``test_wrappers.py``
LAYERS = {
    "rate_limit": (ActionRateLimit, {"max_rate": 20.0}),
    "low_pass": (LowPassAction, {"cutoff": 3.0}),
    "delay": (ActionDelay, {"steps": 2}),
    "scale": (ActionScale, {"schedule": [[0, 0.2], [10, 1.0]]}),
    "history": (HistoryObservation, {"n_observations": 2, "n_actions": 1}),
    "barrier": (JointLimitBarrier, {"low": -1.0, "high": 1.0, "position": [0, 1]}),
    "continuity": (ContinuityCost, {"weight": 0.1}),
    "shield": (
        ActionShield,
        {"constraints": "moving_joints.walls", "guard": "moving_joints.distances"},
    ),
    "template": (SharedControlTemplate, {"phases": PHASES}),
    "rhythm": (CPGPrior, {"mode": "parameters", "omega_swing": 6.0, "amplitude": [1.0, 2.0]}),
}
ALL = pytest.mark.parametrize("layer", LAYERS)


def joints(n=2, **settings):
    return gymnasium.wrappers.TimeLimit(MovingJoints(n, **settings), 50)


def layered(layer, env, **more):
    cls, arguments = LAYERS[layer]
    return cls(env, **arguments | more)


def started(env):
    env.reset(seed=0)
    return env


def played(env, n=30, seed=0):
    """Observations, rewards, infos of random actions, and what the environment was told."""
    generator = np.random.default_rng(seed)
    low, high = env.action_space.low, env.action_space.high
    obs, _ = env.reset(seed=seed)
    rows = [(obs, 0.0, {}, None)]
    for _ in range(n):
        obs, reward, _, _, info = env.step(generator.uniform(low, high).astype(np.float32))
        rows.append((obs, reward, info, env.unwrapped.told))
    return rows


# --- what all layers share -----------------------------------------------------------------------


@ALL
def test_a_layer_keeps_to_its_spaces_and_tells_what_it_did(layer):
    env = layered(layer, joints())

    for obs, _, info, told in played(env)[1:]:
        assert env.observation_space.contains(obs)
        assert {"raw_action", "safe_action", "correction", "constraint_cost"} <= set(info)
        np.testing.assert_array_equal(info["safe_action"], told)
        assert env.env.action_space.contains(info["safe_action"])
        assert info["constraint_cost"] == 0.0


@ALL
def test_the_constructor_s_arguments_are_recorded_in_the_spec(layer):
    gymnasium.register("tests/Joints-v0", lambda **settings: MovingJoints(2, **settings))
    try:
        env = layered(layer, gymnasium.make("tests/Joints-v0"))
        again = gymnasium.make(env.spec)
    finally:
        del gymnasium.registry["tests/Joints-v0"]

    assert str(again) == str(env)
    for (obs, *_), (expected, *_) in zip(played(again, 5), played(env, 5), strict=True):
        np.testing.assert_array_equal(obs, expected)


@ALL
def test_actions_that_are_not_finite_or_not_bounded_reach_no_environment(layer):
    env, unbounded = started(layered(layer, joints())), joints()
    unbounded.unwrapped.action_space = spaces.Box(-np.inf, np.inf, (2,))

    with pytest.raises(ValueError, match="takes finite actions"):
        env.step(np.full(env.action_space.shape, np.nan))
    with pytest.raises(ParameterError, match="bounded Box with one axis"):
        layered(layer, unbounded)


@pytest.mark.parametrize(
    "layer", ["rate_limit", "low_pass", "delay", "scale", "continuity", "rhythm"]
)
def test_the_memory_can_be_left_out_of_observations(layer):
    shown, hidden = layered(layer, joints()), layered(layer, joints(), observe_state=False)

    assert hidden.observation_space == hidden.env.observation_space
    for (seen, *_), (obs, *_) in zip(played(shown), played(hidden), strict=True):
        np.testing.assert_array_equal(seen[:2], obs)


# --- filters -------------------------------------------------------------------------------------


def commands_of(env, actions):
    """What reaches the environment, shape of ``actions``."""
    env.reset(options={"q": np.zeros(env.unwrapped.n)})
    told = []
    for action in actions:
        env.step(np.asarray(action, np.float32))
        told.append(env.unwrapped.told)
    return np.array(told)


def test_a_rate_limit_lets_commands_change_by_rate_times_interval():
    env = ActionRateLimit(joints(), max_rate=[20.0, 40.0])

    told = commands_of(env, [[5.0, -5.0]] * 4 + [[0.0, 0.0]])

    # 20 and 40 units per second, 0.05 s: steps of 1 and 2, from the rest at zero.
    expected = [[1.0, -2.0], [2.0, -4.0], [3.0, -5.0], [4.0, -5.0], [3.0, -3.0]]
    np.testing.assert_allclose(told, expected, rtol=1e-6)


@pytest.mark.parametrize("order", [1, 4, 8])
def test_a_low_pass_is_scipy_s_butterworth(order):
    actions = np.random.default_rng(0).uniform(-3.0, 3.0, (60, 2))  # too small to be clipped

    told = commands_of(LowPassAction(joints(), 4.0, order), actions)

    b, a = signal.butter(order, 4.0, fs=1.0 / DT)
    np.testing.assert_allclose(told, signal.lfilter(b, a, actions, axis=0), atol=1e-5)


def test_the_state_of_a_low_pass_stays_within_its_declared_bounds_at_the_worst_input():
    env = LowPassAction(joints(1), cutoff=1.0, order=4)
    generator = np.random.default_rng(1)
    env.reset(seed=0)

    for _ in range(300):
        for action in [generator.choice([-5.0, 5.0])] * generator.integers(1, 20):
            obs, *_ = env.step(np.array([action], np.float32))
            np.testing.assert_array_less(np.abs(obs[1:]), env.observation_space.high[1:])


def test_a_delay_passes_commands_on_as_many_steps_later():
    actions = np.arange(1.0, 6.0)[:, None] * [1.0, -1.0] * 0.5

    told = commands_of(ActionDelay(joints(), 2), actions)

    np.testing.assert_array_equal(told, np.concatenate([np.zeros((2, 2)), actions[:3]]))


@pytest.mark.parametrize(
    ("layer", "limits", "actions", "expected"),
    [
        # Before an episode, the command nearest to zero.
        (lambda env: ActionDelay(env, 1), (2.0, 5.0), [5.0, 5.0], [2.0, 5.0]),
        # Around the middle of the range.
        (lambda env: ActionScale(env, 0.25), (0.0, 4.0), [4.0, 0.0, 2.0], [2.5, 1.5, 2.0]),
    ],
)
def test_ranges_need_not_have_zero_in_their_middle(layer, limits, actions, expected):
    env = joints(1)
    env.unwrapped.action_space = spaces.Box(*limits, (1,))

    told = commands_of(layer(env), np.array(actions)[:, None])

    np.testing.assert_allclose(told.ravel(), expected)


def test_a_schedule_of_scales_counts_steps_over_episodes_and_begins_where_it_is_told():
    env = ActionScale(joints(), schedule=[[0, 0.2], [4, 1.0]], axes=(0,))
    ended = ActionScale(joints(1), schedule=[[0, 0.2], [4, 1.0]], progress=1.0)
    vec = DummyVecEnv([lambda: ActionScale(joints(1), schedule=[[0, 0.2], [4, 1.0]])])
    vec.reset()
    vec.env_method("set_progress", 0.5)

    told = np.concatenate([commands_of(env, [[5.0, -5.0]] * 3) for _ in range(2)])
    _, _, _, infos = vec.step(np.array([[5.0]], np.float32))

    # The other axis is left alone.
    np.testing.assert_allclose(told[:, 0], [1.0, 2.0, 3.0, 4.0, 5.0, 5.0], rtol=1e-6)
    np.testing.assert_array_equal(told[:, 1], -5.0)
    assert commands_of(ended, [[5.0]]) == pytest.approx(5.0)
    assert infos[0]["safe_action"] == pytest.approx(3.0)
    assert infos[0]["correction"] == pytest.approx(0.0, abs=1e-6)


def test_observations_that_are_no_vector_say_what_helps():
    env = joints()
    env.unwrapped.observation_space = spaces.Dict({"q": spaces.Box(-1.0, 1.0, (2,))})

    for make in (HistoryObservation, lambda env: JointLimitBarrier(env, -1.0, 1.0)):
        with pytest.raises(ParameterError, match="FlattenObservation"):
            make(env)
    with pytest.raises(ParameterError, match="observe_state=False"):
        ActionDelay(env, 1)
    assert ActionDelay(env, 1, observe_state=False).observation_space == env.observation_space


def test_a_history_holds_what_was_seen_and_done_the_latest_first():
    env = HistoryObservation(joints(1), n_observations=2, n_actions=2)
    obs, _ = env.reset(seed=0, options={"q": [0.0]})
    seen = [obs]

    for action in (1.0, 2.0, 3.0):
        seen.append(env.step(np.array([action], np.float32))[0])

    # Positions 0, 0.05, 0.15, 0.3: sums of the actions times 0.05 s.
    np.testing.assert_allclose(seen[0], np.zeros(5))
    np.testing.assert_allclose(seen[1], [0.05, 0.0, 0.0, 1.0, 0.0], rtol=1e-6)
    np.testing.assert_allclose(seen[3], [0.3, 0.15, 0.05, 3.0, 2.0], rtol=1e-6)


def test_a_continuity_cost_is_the_squared_change_of_the_action():
    env = ContinuityCost(joints(1), weight=0.5)
    env.reset(seed=0, options={"q": [0.0]})

    _, first, *_, info = env.step(np.array([2.0], np.float32))
    _, second, *_, more = env.step(np.array([-1.0], np.float32))

    # Positions 0.1 and 0.05; changes 2 (from rest) and -3.
    assert first == pytest.approx(-0.01 - 0.5 * 4.0, rel=1e-5)
    assert second == pytest.approx(-0.0025 - 0.5 * 9.0, rel=1e-5)
    assert (info["continuity_cost"], more["continuity_cost"]) == pytest.approx((2.0, 4.5))


@pytest.mark.parametrize(
    ("layer", "arguments", "says"),
    [
        (ActionRateLimit, {"max_rate": -1.0}, "max_rate must be above 0"),
        (ActionRateLimit, {"max_rate": [1.0] * 3}, "3 values of max_change"),
        (ActionRateLimit, {"max_rate": 1.0, "store": "both"}, "store must be one of"),
        (LowPassAction, {"cutoff": 10.0}, "below 10 Hz"),
        (LowPassAction, {"cutoff": 1.0, "order": 9}, "whole number from 1 to 8"),
        (ActionDelay, {"steps": 0}, "whole number of at least 1"),
        (ActionScale, {}, "either a scale or a schedule"),
        (ActionScale, {"scale": 1.5}, "at most 1"),
        (ActionScale, {"scale": 0.5, "axes": [2]}, "numbers of the 2 actuators, from 0 to 1"),
        (ActionScale, {"schedule": [[5, 0.1]]}, "growing from 0"),
        (ActionScale, {"schedule": [[0, 0.2], [10]]}, "list of pairs"),
        (ActionScale, {"schedule": [[0, 0.2]], "progress": 2.0}, "from 0 to 1"),
        (HistoryObservation, {"n_observations": 0, "n_actions": 0}, "must be positive"),
        (ContinuityCost, {"weight": -1.0}, "at least 0"),
    ],
)
def test_arguments_out_of_range_are_refused_at_the_door(layer, arguments, says):
    with pytest.raises(ParameterError, match=says):
        layer(joints(), **arguments)


def test_an_environment_that_does_not_tell_its_interval_needs_it_passed():
    env = gymnasium.make("MountainCarContinuous-v0")

    with pytest.raises(ParameterError, match="Pass dt=SECONDS"):
        ActionRateLimit(env, 1.0)
    assert ActionRateLimit(env, 1.0, dt=0.1).twin_transform.max_change == pytest.approx(0.1)


# --- nested layers -------------------------------------------------------------------------------


def test_nested_layers_tell_the_first_action_the_last_command_and_all_corrections():
    env = ActionRateLimit(JointLimitBarrier(joints(1), -1.0, 1.0), max_rate=60.0)
    env.reset(seed=0, options={"q": [0.9]})

    *_, info = env.step(np.array([5.0], np.float32))

    # The rate limit lets 3 of 5 pass; the barrier half of the distance of 0.1 in 0.05 s.
    assert info["raw_action"] == pytest.approx(5.0)
    assert info["safe_action"] == pytest.approx(1.0, rel=1e-4)
    assert info["correction"] == pytest.approx(-4.0, rel=1e-4)


@pytest.mark.parametrize(
    ("outer", "inner", "expected"),
    [("raw", "raw", None), ("raw", "executed", None), ("executed", "raw", 1.0)],
)
def test_the_outermost_layer_decides_what_is_stored(outer, inner, expected):
    env = JointLimitBarrier(joints(1), -1.0, 1.0, store=inner)
    env = ActionRateLimit(env, max_rate=60.0, store=outer)
    env.reset(seed=0, options={"q": [0.9]})

    *_, info = env.step(np.array([5.0], np.float32))

    assert ("stored_action" in info) == (expected is not None)
    if expected is not None:
        assert info["stored_action"] == pytest.approx(expected, rel=1e-4)


def test_a_stored_action_is_in_the_units_of_the_policy():
    env = ActionScale(ActionRateLimit(joints(1), max_rate=40.0), 0.5, store="executed")
    env.reset(seed=0)

    *_, info = env.step(np.array([5.0], np.float32))

    # Half of 5 is asked for, 2 per step is let through: as much as an action of 4.
    assert info["safe_action"] == pytest.approx(2.0)
    assert info["stored_action"] == pytest.approx(4.0)


@pytest.mark.parametrize(
    "safe",
    [
        lambda env: JointLimitBarrier(env, -1.0, 1.0),
        lambda env: ActionShield(env, ([[1.0]], [1.0])),
        lambda env: SharedControlTemplate(env, [Phase("only", [[1.0]])]),
    ],
)
def test_a_safety_layer_has_the_last_word(safe):
    with pytest.raises(ParameterError, match="ActionRateLimit below it changes commands"):
        safe(HistoryObservation(ActionRateLimit(joints(1), 20.0)))
    safe(ContinuityCost(HistoryObservation(joints(1)), 1.0))


# --- barrier and shield: nothing gets through ----------------------------------------------------


def attacks(generator, obs, low, high):
    """What an adversary tries: the limits, far beyond them, noise, and a push outwards."""
    kind = generator.integers(4)
    if kind == 0:
        return generator.choice([low, high])
    if kind == 1:
        return generator.normal(size=low.shape) * 1e6
    if kind == 2:
        return generator.uniform(low, high)
    return 1e3 * np.sign(obs[: low.size]) * high


@pytest.fixture
def unchecked():
    """Without checks of shapes, which take ten times as long as all the rest of an episode."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def worst_of(env, margins, n_episodes=300, n_steps=10, seed=0):
    """The smallest margin that attacks reach over random episodes."""
    generator = np.random.default_rng(seed)
    low, high = env.action_space.low, env.action_space.high
    smallest = np.inf
    for episode in range(n_episodes):
        obs, _ = env.reset(seed=seed + episode)
        for _ in range(n_steps):
            obs, _, _, _, info = env.step(attacks(generator, obs, low, high))
            assert info["constraint_cost"] == 0.0
            smallest = min(smallest, float(np.min(margins(env.unwrapped.q))))
    return smallest


@pytest.mark.parametrize(("share", "angles"), [(0.3, True), (1.0, False)])
def test_no_attack_gets_a_joint_past_a_barrier_in_300_episodes(share, angles, unchecked):
    position = [[0, 2], [1, 3]] if angles else [0, 1]
    env = JointLimitBarrier(
        MovingJoints(2, angles=angles), -1.0, 1.2, position=position, share=share
    )

    smallest = worst_of(env, lambda q: np.minimum(q + 1.0, 1.2 - q))

    assert 0.0 <= smallest < 0.05  # and attacks do come close


def test_a_barrier_counts_with_a_drive_that_misses_by_its_tolerance(unchecked):
    # 10 % of at most 5 rad/s in 0.05 s is 0.025 rad.
    env = JointLimitBarrier(MovingJoints(2, lag=0.1), -1.0, 1.0, position=[0, 1], tolerance=0.0251)

    assert worst_of(env, lambda q: 1.0 - np.abs(q)) >= 0.0


def test_no_attack_gets_two_joints_past_coupled_walls_in_300_episodes(unchecked):
    env = ActionShield(MovingJoints(2), walls, guard=distances)

    smallest = worst_of(env, distances)

    assert 0.0 <= smallest < 0.02


def test_a_barrier_takes_its_share_of_the_distance():
    env = JointLimitBarrier(joints(1), -1.0, 1.0, share=0.5)
    env.reset(seed=0, options={"q": [0.8]})

    obs, *_ = env.step(np.array([5.0], np.float32))

    # Half of 0.2, less the tolerance of 1e-6.
    assert obs[0] == pytest.approx(0.9, abs=2e-6)


def test_a_joint_that_is_not_commanded_by_its_speed_is_found_out():
    lagging, exact = (JointLimitBarrier(joints(1, lag=lag), -1.0, 1.0) for lag in (0.5, 0.0))
    pendulum = JointLimitBarrier(gymnasium.make("Pendulum-v1"), -2.0, 2.0, position=[[0, 1]])

    for env in (lagging, exact):
        env.reset(seed=0, options={"q": [0.0]})
    assert exact.step(np.array([0.5], np.float32))[-1]["tracking_error"] < 1e-6
    with pytest.raises(SafetyError, match="missed what its speed command asks for"):
        lagging.step(np.array([0.5], np.float32))
    with pytest.raises(SafetyError):
        for seed in range(5):
            pendulum.reset(seed=seed)
            pendulum.step(np.array([1.0], np.float32))


@pytest.mark.parametrize("on_breach", ["raise", "warn", "ignore"])
def test_an_episode_that_begins_outside_is_reported_as_asked(on_breach):
    env = JointLimitBarrier(joints(1), -1.0, 1.0, on_breach=on_breach)
    outside = {"q": [1.5]}

    if on_breach == "raise":
        with pytest.raises(SafetyError, match=r"begins 0\.5 beyond"):
            env.reset(options=outside)
        return
    if on_breach == "warn":
        with pytest.warns(UserWarning, match=r"begins 0\.5 beyond"):
            env.reset(options=outside)
    else:
        env.reset(options=outside)
    *_, info = env.step(np.array([5.0], np.float32))

    # It is brought back by half of the distance, within what the drive can do in a step: 0.25.
    assert info["constraint_cost"] == pytest.approx(0.25, abs=1e-5)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"low": 1.0}, "high must be above low"),
        ({"high": np.inf}, "must be finite"),
        ({"position": [7]}, "an observation has 1"),
        ({"action": [3]}, "command 3 is not"),
        ({"share": 0.0}, "share must be above 0"),
        ({"low": -4.0, "position": [[0, 0]]}, "half a turn"),
        ({"tolerance": 0.6}, "high must be above low by more than 2.4"),
        ({"position": []}, "position is a list"),
        ({"position": [[0, 0, 0]]}, "position is a list"),
        ({"low": [-1.0, -1.0]}, "one for each of the 1 joints"),
        ({"gain": [1.0, 2.0]}, "one number for all joints"),
        ({"on_breach": "pray"}, "on_breach must be one of"),
    ],
)
def test_a_barrier_that_cannot_hold_is_refused_at_the_door(arguments, says):
    with pytest.raises(ParameterError, match=says):
        JointLimitBarrier(joints(1), **{"low": -1.0, "high": 1.0} | arguments)


def test_a_command_that_cannot_be_zero_is_refused_by_a_barrier():
    env = joints(1)
    env.unwrapped.action_space = spaces.Box(1.0, 5.0, (1,))

    with pytest.raises(ParameterError, match="speeds that can be zero and of either sign"):
        JointLimitBarrier(env, -1.0, 1.0)


# --- shield --------------------------------------------------------------------------------------


def test_a_shield_projects_onto_the_nearest_allowed_command():
    env = ActionShield(joints(2), ([[1.0, 1.0]], [2.0]))

    told = commands_of(env, [[3.0, 3.0], [4.0, 0.0], [1.0, 0.5]])

    # Onto u1 + u2 <= 2, along its normal; what is allowed stays.
    np.testing.assert_allclose(told, [[1.0, 1.0], [3.0, -1.0], [1.0, 0.5]], atol=1e-5)


@pytest.mark.parametrize("n", [2, 12])
def test_a_projection_meets_the_conditions_of_optimality(n):
    generator = np.random.default_rng(n)
    low, high = -np.ones(n), np.ones(n)
    for _ in range(30):
        G = generator.normal(size=(2 * n, n))
        h = G @ generator.uniform(-0.5, 0.5, n) + generator.uniform(0.01, 0.3, 2 * n)
        wanted = generator.uniform(-2.0, 2.0, n)

        found = nearest(wanted, G, h, low, high)

        # No feasible point is nearer: (wanted - found) points out of the set at `found`.
        everything = np.concatenate([G, np.eye(n), -np.eye(n)])
        limits = np.concatenate([h, high, -low])
        assert np.all(everything @ found <= limits)
        active = everything[everything @ found > limits - 1e-5]
        pull = np.clip(wanted, low, high) - found
        residual = optimize.nnls(active.T, pull)[1] if len(active) else np.linalg.norm(pull)
        assert residual < 1e-5


@pytest.mark.parametrize(("scale", "unit"), [(1e-9, 1.0), (1e-3, 1e3), (1e6, 1e-4)])
def test_a_projection_does_not_depend_on_units(scale, unit):
    generator = np.random.default_rng(0)
    for _ in range(30):
        G = generator.normal(size=(5, 3))
        h = G @ generator.uniform(-0.5, 0.5, 3) + generator.uniform(0.01, 0.3, 5)
        wanted, most = generator.uniform(-2.0, 2.0, 3), np.ones(3)

        found = nearest(unit * wanted, scale * G, unit * scale * h, -unit * most, unit * most)

        np.testing.assert_allclose(found / unit, nearest(wanted, G, h, -most, most), atol=1e-9)
        assert np.all(G @ found <= unit * h)
    # A constraint without coefficients holds or does not.
    assert nearest(wanted, np.zeros((1, 3)), np.zeros(1), -2 * most, 2 * most) is not None
    assert nearest(wanted, np.zeros((1, 3)), np.full(1, -1e-9), -most, most) is None


def test_a_shield_without_any_allowed_command_raises_or_falls_back():
    contradiction = lambda obs: ([[1.0], [-1.0]], [-1.0, -1.0])  # noqa: E731
    action = np.array([1.0], np.float32)
    strict = ActionShield(joints(1), contradiction)
    strict.reset(seed=0)

    with pytest.raises(SafetyError, match="No command satisfies"):
        strict.step(action)
    env = ActionShield(joints(1), contradiction, fallback=[0.0])
    env.reset(seed=0)
    *_, info = env.step(action)

    assert info["safe_action"] == 0.0 and info["infeasible"]
    assert info["constraint_cost"] == pytest.approx(2.0)  # 0 <= -1 is missed by 1, twice


def test_a_guard_finds_out_constraints_that_do_not_protect():
    nothing = lambda obs: ([[0.0, 0.0]], [1.0])  # noqa: E731
    env = ActionShield(joints(2), nothing, guard=distances)
    env.reset(seed=0, options={"q": [0.4, 0.4]})

    with pytest.raises(SafetyError, match="below zero"):
        env.step(np.array([5.0, 5.0], np.float32))


@pytest.mark.parametrize(
    ("constraints", "says"),
    [
        (([[1.0, 0.0, 0.0]], [1.0]), "of shape"),
        (([[1.0, np.nan]], [1.0]), "finite"),
        (([[1.0, 0.0], [-1.0, 0.0]], [-1.0, -1.0]), "no command within the limits"),
        ("nowhere.at_all", "no function"),
        (3, "of shape"),
    ],
)
def test_constraints_that_cannot_be_kept_are_refused_at_the_door(constraints, says):
    with pytest.raises(ParameterError, match=says):
        ActionShield(joints(2), constraints)


# --- shared control ------------------------------------------------------------------------------


def test_a_template_maps_few_inputs_to_commands_phase_by_phase():
    env = SharedControlTemplate(joints(2), PHASES)
    obs, _ = env.reset(seed=0, options={"q": [0.4, 0.0]})
    forward = np.array([1.0], np.float32)

    assert env.action_space.shape == (1,)
    np.testing.assert_allclose(obs, [0.4, 0.0, 1.0, 0.0], rtol=1e-6)
    obs, *_, info = env.step(forward)  # to the right, beyond 0.5: the next phase
    np.testing.assert_allclose(obs, [0.65, 0.0, 0.0, 1.0], rtol=1e-6)
    assert info["phase"] == "up" and info["correction"] == pytest.approx([0.0, 0.0])
    obs, *_, info = env.step(forward)  # upwards, no faster than 2
    np.testing.assert_allclose(obs[:2], [0.65, 0.1], rtol=1e-5)
    assert info["correction"] == pytest.approx([0.0, -3.0], abs=1e-5)


def test_a_template_begins_each_episode_in_its_first_phase():
    env = SharedControlTemplate(joints(2), PHASES)

    # In the first of these, the condition of the first phase holds at once.
    for start, phase in ((0.6, "up"), (0.0, "right")):
        env.reset(options={"q": [start, 0.0]})
        assert env.phase == phase


def test_a_mapping_may_depend_on_the_observation():
    turned = Phase("towards", lambda obs: np.array([[obs[1]], [-obs[0]]]), offset=[1.0, 0.0])
    flat = Phase("rest", [[0.0], [0.0]])
    env = SharedControlTemplate(joints(2), [turned, flat])
    env.reset(options={"q": [0.5, 0.25]})

    *_, info = env.step(np.array([1.0], np.float32))

    np.testing.assert_allclose(info["safe_action"], [1.25, -0.5], rtol=1e-6)


@pytest.mark.parametrize(
    ("phases", "says"),
    [
        ([], "names of their own"),
        ([Phase("a", [[1.0], [0.0]])] * 2, "names of their own"),
        ([Phase("a", [[1.0]])], r"shape \(2, n_inputs\)"),
        ([Phase("a", [[1.0], [0.0]]), Phase("b", np.eye(2))], "same number of inputs"),
        ([Phase("a", np.eye(2), offset=[1.0])], "offset"),
        ([Phase("a", np.eye(2), transitions=[{"to": "b", "when": distances}])], "leads to"),
        ([Phase("a", np.eye(2), transitions=[{"to": "a", "when": {"channel": 9}}])], "condition"),
        ([Phase("a", np.eye(2), transitions=[{"when": distances}])], "needs 'to'"),
        ([Phase("a", np.eye(2), constraints=([[1.0, 0.0]], [-9.0]))], "No command between"),
        ([{"name": "a", "map": np.eye(2)}], "A phase is a dictionary"),
    ],
)
def test_phases_that_do_not_fit_are_refused_at_the_door(phases, says):
    with pytest.raises(ParameterError, match=says):
        SharedControlTemplate(joints(2), phases)
