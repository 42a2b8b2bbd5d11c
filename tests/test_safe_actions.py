"""Layers that make actions smooth and safe: what they do to commands, observations and info."""

import gymnasium
import jaxtyping
import numpy as np
import pytest
from cases import each
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
    HistoryObservation,
    JointLimitBarrier,
    LowPassAction,
    Phase,
    SharedControlTemplate,
)
from sb3_hds.wrappers.safety.shield import nearest

PHASES = [
    {
        "name": "right",
        "mapping": [[5.0], [0.0]],
        "transitions": [{"to": "up", "when": {"channel": 0, "above": 0.5}}],
    },
    {"name": "up", "mapping": [[0.0], [5.0]], "constraints": ([[0.0, 1.0]], [2.0])},
]


def joints(n=2, **settings):
    return gymnasium.wrappers.TimeLimit(MovingJoints(n, **settings), 50)


@each(
    (ActionRateLimit, {"max_rate": 20.0}),
    (LowPassAction, {"cutoff": 3.0}),
    (ActionDelay, {"steps": 2}),
    (ActionScale, {"schedule": [[0, 0.2], [10, 1.0]]}),
    (ContinuityCost, {"weight": 0.1}),
    (SharedControlTemplate, {"phases": PHASES}),
)
def test_the_memory_can_be_left_out_of_observations(layer, arguments):
    shown, hidden = (layer(joints(), **arguments, observe_state=seen) for seen in (True, False))

    assert hidden.observation_space == hidden.env.observation_space
    for env in (shown, hidden):
        env.reset(seed=0)
    action = np.ones(shown.action_space.shape, np.float32)
    for _ in range(3):
        np.testing.assert_array_equal(shown.step(action)[0][:2], hidden.step(action)[0])


def commands_of(env, actions):
    """What reaches the environment, shape of ``actions``."""
    env.reset(options={"q": np.zeros(env.unwrapped.n)})
    told = []
    for action in actions:
        env.step(np.asarray(action, np.float32))
        told.append(env.unwrapped.told)
    return np.array(told)


LIMITED, TOGETHER = [[1, -2], [2, -4], [3, -5], [2, -3]], ([[1.0, 1.0]], [2.0])


@each(
    # 20 and 40 units per second, 0.05 s: steps of 1 and 2, from the rest at zero.
    (ActionRateLimit, [20.0, 40.0], (-5, 5), [[5, -5]] * 3 + [[0, 0]], LIMITED),
    (ActionDelay, 2, (-5, 5), [[1, -1], [2, -2], [3, -3]], [[0, 0], [0, 0], [1, -1]]),
    # Before an episode, the command nearest to zero.
    (ActionDelay, 1, (2.0, 5.0), [[5, 4]] * 2, [[2, 2], [5, 4]]),
    # Around the middle of the range.
    (ActionScale, 0.25, (0.0, 4.0), [[4, 0], [0, 2]], [[2.5, 1.5], [1.5, 2]]),
    # Onto u1 + u2 <= 2, along its normal; what is allowed stays.
    (ActionShield, TOGETHER, (-5, 5), [[3, 3], [4, 0], [1, 0.5]], [[1, 1], [3, -1], [1, 0.5]]),
    ids=["rate limit", "delay", "delay of a push", "scale", "shield"],
)
def test_a_layer_makes_of_commands_what_its_formula_says(layer, given, limits, actions, expected):
    env = joints()
    env.unwrapped.action_space = spaces.Box(*limits, (2,))
    np.testing.assert_allclose(commands_of(layer(env, given), actions), expected, atol=1e-5)


@pytest.mark.parametrize("order", [1, 8])
def test_a_low_pass_is_scipy_s_butterworth(order):
    actions = np.random.default_rng(0).uniform(-3.0, 3.0, (60, 2))  # too small to be clipped
    told = commands_of(LowPassAction(joints(), 4.0, order), actions)
    b, a = signal.butter(order, 4.0, fs=1.0 / DT)
    np.testing.assert_allclose(told, signal.lfilter(b, a, actions, axis=0), atol=1e-5)


def test_the_state_of_a_low_pass_stays_within_its_declared_bounds_at_the_worst_input():
    env = LowPassAction(joints(1), cutoff=1.0, order=4)
    generator = np.random.default_rng(1)
    env.reset(seed=0)

    for _ in range(100):
        for action in [generator.choice([-5.0, 5.0])] * generator.integers(1, 20):
            obs, *_ = env.step(np.array([action], np.float32))
            np.testing.assert_array_less(np.abs(obs[1:]), env.observation_space.high[1:])


def test_a_schedule_of_scales_counts_steps_over_episodes_and_begins_where_it_is_told():
    schedule = [[0, 0.2], [4, 1.0]]
    env = ActionScale(joints(), schedule=schedule, axes=(0,))
    ended = ActionScale(joints(1), schedule=schedule, progress=1.0)
    vec = DummyVecEnv([lambda: ActionScale(joints(1), schedule=schedule)])
    vec.reset()
    vec.env_method("set_progress", 0.5)

    told = np.concatenate([commands_of(env, [[5.0, -5.0]] * 3) for _ in range(2)])
    _, _, _, [info] = vec.step(np.array([[5.0]], np.float32))

    # The other axis is left alone.
    np.testing.assert_allclose(told[:, 0], [1.0, 2.0, 3.0, 4.0, 5.0, 5.0], rtol=1e-6)
    np.testing.assert_array_equal(told[:, 1], -5.0)
    assert commands_of(ended, [[5.0]]) == pytest.approx(5.0)
    assert info["safe_action"] == pytest.approx(3.0)


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


def test_an_environment_that_does_not_tell_its_interval_needs_it_passed():
    env = gymnasium.make("MountainCarContinuous-v0")
    with pytest.raises(ParameterError, match="Pass dt=SECONDS"):
        ActionRateLimit(env, 1.0)
    assert ActionRateLimit(env, 1.0, dt=0.1).twin_transform.max_change == pytest.approx(0.1)


def test_nested_layers_tell_the_first_action_the_last_command_and_all_corrections():
    def stored(outer, inner):
        env = JointLimitBarrier(joints(1), -1.0, 1.0, store=inner)
        env = ActionRateLimit(env, max_rate=60.0, store=outer)
        env.reset(seed=0, options={"q": [0.9]})
        return env.step(np.array([5.0], np.float32))[-1]

    # The rate limit lets 3 of 5 pass; the barrier half of the distance of 0.1 in 0.05 s.
    info = stored("raw", "executed")
    assert info["raw_action"] == pytest.approx(5.0)
    assert info["safe_action"] == pytest.approx(1.0, rel=1e-4)
    assert info["correction"] == pytest.approx(-4.0, rel=1e-4)
    # The outermost layer decides what is stored.
    assert "stored_action" not in info
    assert stored("executed", "raw")["stored_action"] == pytest.approx(1.0, rel=1e-4)
    # In units of the policy: half of 5 is asked for, 2 is let through, as much as an action of 4.
    env = ActionScale(ActionRateLimit(joints(1), max_rate=40.0), 0.5, store="executed")
    env.reset(seed=0)
    assert env.step(np.array([5.0], np.float32))[-1]["stored_action"] == pytest.approx(4.0)


@each(
    lambda env: JointLimitBarrier(env, -1.0, 1.0),
    lambda env: ActionShield(env, ([[1.0]], [1.0])),
    lambda env: SharedControlTemplate(env, [Phase("only", [[1.0]])]),
)
def test_a_safety_layer_has_the_last_word(safe):
    with pytest.raises(ParameterError, match="ActionRateLimit below it changes commands"):
        safe(HistoryObservation(ActionRateLimit(joints(1), 20.0)))
    safe(ContinuityCost(HistoryObservation(joints(1)), 1.0))


@pytest.fixture
def unchecked():
    """Without checks of shapes, which take ten times as long as all the rest of an episode."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def worst_of(env, margins, n_episodes=150, n_steps=10):
    """The smallest margin that an adversary reaches: limits, far beyond, noise, pushes outwards."""
    generator = np.random.default_rng(0)
    low, high = env.action_space.low, env.action_space.high
    smallest = np.inf
    for episode in range(n_episodes):
        obs, _ = env.reset(seed=episode)
        for _ in range(n_steps):
            attacks = [
                generator.choice([low, high]),
                generator.normal(size=low.shape) * 1e6,
                generator.uniform(low, high),
                1e3 * np.sign(obs[: low.size]) * high,
            ]
            obs, _, _, _, info = env.step(attacks[generator.integers(4)])
            assert info["constraint_cost"] == 0.0
            smallest = min(smallest, float(np.min(margins(env.unwrapped.q))))
    return smallest


def barrier(env, **settings):
    return JointLimitBarrier(env, **{"low": -1.0, "high": 1.2, "position": [0, 1]} | settings)


def rail(q):
    return np.minimum(q + 1.0, 1.2 - q)


@each(
    (barrier(MovingJoints(2), share=1.0), rail, 0.05),
    (barrier(MovingJoints(2, angles=True), position=[[0, 2], [1, 3]], share=0.3), rail, 0.05),
    # A drive that misses by 10 % of at most 5 rad/s in 0.05 s: 0.025 rad.
    (barrier(MovingJoints(2, lag=0.1), tolerance=0.0251), rail, 0.1),
    (ActionShield(MovingJoints(2), walls, guard=distances), distances, 0.02),
    ids=["barrier", "angles", "lagging drive", "coupled walls"],
)
def test_no_attack_gets_past_a_limit_in_150_episodes(env, margins, closest, unchecked):
    assert 0.0 <= worst_of(env, margins) < closest  # and attacks do come close


def test_a_joint_that_is_not_commanded_by_its_speed_is_found_out():
    lagging, exact = (JointLimitBarrier(joints(1, lag=lag), -1.0, 1.0) for lag in (0.5, 0.0))

    for env in (lagging, exact):
        env.reset(seed=0, options={"q": [0.0]})
    assert exact.step(np.array([0.5], np.float32))[-1]["tracking_error"] < 1e-6
    with pytest.raises(SafetyError, match="missed its commanded position"):
        lagging.step(np.array([0.5], np.float32))


def test_an_episode_that_begins_outside_is_reported_as_asked():
    strict, talkative, quiet = (
        JointLimitBarrier(joints(1), -1.0, 1.0, on_breach=how)
        for how in ("raise", "warn", "ignore")
    )
    outside = {"q": [1.5]}

    with pytest.raises(SafetyError, match=r"begins 0\.5 beyond"):
        strict.reset(options=outside)
    with pytest.warns(UserWarning, match=r"begins 0\.5 beyond"):
        talkative.reset(options=outside)
    quiet.reset(options=outside)
    *_, info = quiet.step(np.array([5.0], np.float32))

    # It is brought back by half of the distance, within what the drive can do in a step: 0.25.
    assert info["constraint_cost"] == pytest.approx(0.25, abs=1e-5)


TURN = np.eye(2)


def one_phase(env, **settings):
    return SharedControlTemplate(env, [Phase("a", TURN, **settings)])


UNBOUNDED = {"action_space": spaces.Box(-np.inf, np.inf, (2,))}
FORWARD = {"action_space": spaces.Box(1.0, 5.0, (2,))}


@each(
    (ActionDelay, {"steps": 2, **UNBOUNDED}, "bounded Box with one axis"),
    (ActionRateLimit, {"max_rate": -1.0}, "max_rate must be above 0"),
    (ActionRateLimit, {"max_rate": 1.0, "store": "both"}, "store must be one of"),
    (LowPassAction, {"cutoff": 10.0}, "below 10 Hz"),
    (LowPassAction, {"cutoff": 1.0, "order": 9}, "from 1 to 8"),
    (ActionScale, {}, "either a scale or a schedule"),
    (ActionScale, {"scale": 0.5, "axes": [2]}, "from 0 to 1"),
    (ActionScale, {"schedule": [[5, 0.1]]}, "growing from 0"),
    (HistoryObservation, {"n_observations": 0, "n_actions": 0}, "must be positive"),
    (barrier, {"low": 1.2}, "high must be above low"),
    (barrier, {"position": [0, 7]}, "an observation has 2"),
    (barrier, {"low": -4.0, "position": [[0, 1], [1, 0]]}, "half a turn"),
    (barrier, {"tolerance": 0.6}, "more than 2.4"),
    (barrier, {"on_breach": "pray"}, "on_breach must be one of"),
    (barrier, FORWARD, "speeds of either sign"),
    (ActionShield, {"constraints": ([[1.0, 0.0, 0.0]], [1.0])}, "of shape"),
    (ActionShield, {"constraints": ([[1.0, 0.0], [-1.0, 0.0]], [-1.0] * 2)}, "no command"),
    (ActionShield, {"constraints": "nowhere.at_all"}, "no function"),
    (SharedControlTemplate, {"phases": [Phase("a", TURN)] * 2}, "unique names"),
    (SharedControlTemplate, {"phases": [Phase("a", [[1.0]])]}, r"shape \(2, n_inputs\)"),
    (one_phase, {"transitions": [{"to": "b", "when": distances}]}, "leads to"),
    (one_phase, {"transitions": [{"to": "a", "when": {"channel": 9}}]}, "condition"),
    (one_phase, {"constraints": ([[1.0, 0.0]], [-9.0])}, "No command between"),
    (SharedControlTemplate, {"phases": [{"name": "a", "map": TURN}]}, "is a dictionary"),
)
def test_what_makes_no_sense_is_refused_at_the_door(layer, arguments, says):
    env, arguments = joints(2), dict(arguments)
    if space := arguments.pop("action_space", None):
        env.unwrapped.action_space = space
    with pytest.raises(ParameterError, match=says):
        layer(env, **arguments)


@each((2, 1.0, 1.0), (12, 1.0, 1.0), (3, 1e-9, 1.0), (3, 1e6, 1e-4))
def test_a_projection_meets_the_conditions_of_optimality_in_any_units(n, scale, unit):
    generator, most = np.random.default_rng(n), np.ones(n)
    for _ in range(30):
        G = generator.normal(size=(2 * n, n))
        h = G @ generator.uniform(-0.5, 0.5, n) + generator.uniform(0.01, 0.3, 2 * n)
        wanted = generator.uniform(-2.0, 2.0, n)

        given = unit * wanted, scale * G, unit * scale * h, -unit * most, unit * most
        found = nearest(*given) / unit

        # No feasible point is nearer: (wanted - found) points out of the set at `found`.
        everything = np.concatenate([G, np.eye(n), -np.eye(n)])
        limits = np.concatenate([h, most, most])
        assert np.all(everything @ found <= limits * (1.0 + 1e-12 * (unit != 1.0)))
        active = everything[everything @ found > limits - 1e-5]
        pull = np.clip(wanted, -1.0, 1.0) - found
        residual = optimize.nnls(active.T, pull)[1] if len(active) else np.linalg.norm(pull)
        assert residual < 1e-5
    # A constraint without coefficients holds or does not.
    assert nearest(wanted, np.zeros((1, n)), np.zeros(1), -2 * most, 2 * most) is not None
    assert nearest(wanted, np.zeros((1, n)), np.full(1, -1e-9), -most, most) is None


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


def test_a_mapping_may_depend_on_the_observation_and_episodes_begin_in_the_first_phase():
    turned = Phase("towards", lambda obs: np.array([[obs[1]], [-obs[0]]]), offset=[1.0, 0.0])
    env = SharedControlTemplate(joints(2), [turned, Phase("rest", [[0.0], [0.0]])])
    env.reset(options={"q": [0.5, 0.25]})

    *_, info = env.step(np.array([1.0], np.float32))

    np.testing.assert_allclose(info["safe_action"], [1.25, -0.5], rtol=1e-6)
    # In the first of these episodes, the condition of the first phase holds at once.
    env = SharedControlTemplate(joints(2), PHASES)
    for start, phase in ((0.6, "up"), (0.0, "right")):
        env.reset(options={"q": [start, 0.0]})
        assert env.phase == phase
