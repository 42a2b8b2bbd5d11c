"""What an algorithm is given by mistake: a clear error each, and nothing half-done."""

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from small_models import NAMES, PLANNERS, SMALL, small

from sb3_hds import algos
from sb3_hds.errors import EnvironmentMismatchError, NoTwinError, ParameterError

pytestmark = pytest.mark.usefixtures("quick_compilation")
every_algorithm = pytest.mark.parametrize("name", NAMES)
every_planner = pytest.mark.parametrize("name", PLANNERS)

OBS = spaces.Box(-1.0, 1.0, (3,))
ACT = spaces.Box(-1.0, 1.0, (1,))


class Spaces(gymnasium.Env):
    """Has these spaces and nothing behind them."""

    def __init__(self, observation_space: spaces.Space, action_space: spaces.Space) -> None:
        self.observation_space, self.action_space = observation_space, action_space

    def reset(self, *, seed=None, options=None):
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, False, False, {}


@every_algorithm
@pytest.mark.parametrize(
    "action_space, reason",
    [
        (spaces.Discrete(3), r"only supports.*Box.*Discrete\(3\)"),
        (spaces.MultiDiscrete([2, 2]), r"only supports.*Box"),
        (spaces.Box(-np.inf, np.inf, (1,)), "finite lower and upper bound"),
    ],
    ids=["discrete", "multi-discrete", "unbounded"],
)
def test_actions_that_are_not_bounded_and_continuous_are_refused(name, action_space, reason):
    with pytest.raises(AssertionError, match=reason):
        small(name, Spaces(OBS, action_space))


@every_planner
@pytest.mark.parametrize(
    "space",
    [
        spaces.Dict({"a": OBS, "b": OBS}),
        spaces.Box(0, 255, (8, 8, 3), np.uint8),
        spaces.Discrete(5),
        spaces.Box(-1.0, 1.0, (3, 2)),
    ],
    ids=["dictionary", "image", "discrete", "matrix"],
)
def test_observations_that_no_twin_has_are_refused(name, space):
    with pytest.raises(EnvironmentMismatchError, match="A twin observes a Box with one axis"):
        small(name, Spaces(space, ACT))


@every_planner
def test_an_environment_without_a_twin_is_told_what_has_one_and_how_to_add_one(name):
    with pytest.raises(NoTwinError, match=r"'Spaces'(.|\n)*Pendulum-v1(.|\n)*twins\.register"):
        small(name, Spaces(OBS, ACT))


@every_planner
def test_a_twin_of_another_system_is_refused(name):
    with pytest.raises(EnvironmentMismatchError, match="MountainCar"):
        small(name, twin="MountainCar")
    with pytest.raises(NoTwinError, match="Did you mean 'Pendulum'"):
        small(name, twin="Pendulun")


@every_planner
def test_physics_out_of_bounds_is_refused(name):
    with pytest.raises(ParameterError, match="mass"):
        small(name).twin.with_parameters(mass=-1.0)


@every_algorithm
def test_an_unknown_environment_is_named(name):
    with pytest.raises(gymnasium.error.NameNotFound, match="Nowhere"):
        algos.ALL[name]("Nowhere-v0")


@every_algorithm
def test_an_algorithm_without_an_environment_says_that_it_needs_one(name):
    with pytest.raises(ValueError, match="needs an environment"):
        algos.ALL[name]()
    with pytest.raises(ValueError, match="needs an environment"):
        algos.ALL[name]("MlpPolicy")


@every_algorithm
def test_an_unknown_policy_is_refused(name):
    with pytest.raises(ValueError, match="has no policy 'CnnPolicy': use MlpPolicy"):
        algos.ALL[name]("CnnPolicy", "Pendulum-v1")


@every_algorithm
@pytest.mark.parametrize(
    "obs",
    [np.zeros(2), np.zeros((5, 4)), np.zeros((2, 3, 1)), np.float32(0.0)],
    ids=lambda obs: str(obs.shape),
)
def test_an_observation_of_another_shape_is_refused(name, obs):
    with pytest.raises(ValueError, match="shape"):
        small(name).predict(obs)


@every_algorithm
@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_an_observation_that_is_not_finite_gets_no_action(name, value):
    with pytest.raises(ValueError, match="not finite"):
        small(name).predict(np.array([1.0, 0.0, value], np.float32))


@every_algorithm
def test_the_pair_that_reset_returns_is_no_observation(name):
    model, env = small(name), gymnasium.make("Pendulum-v1")

    with pytest.raises(ValueError, match="mixing Gym API"):
        model.predict(env.reset())


@every_planner
@pytest.mark.parametrize(
    "argument, value",
    [
        ("n_rollouts", 0),
        ("n_rollouts", 8.5),
        ("horizon", 0),
        ("horizon", "long"),
        ("lookahead", -1),
        ("order", 3),
        ("planner", "best"),
        ("n_iterations", 0),
        ("n_step_sizes", 1),
        ("n_random_plans", -1),
        ("plan_memory", 0),
        ("pretrain_epochs", -1),
        ("pretrain_epochs", None),
        ("batch_size", 0),
        ("gradient_steps", -2),
        ("gamma", 0.0),
        ("gamma", 1.01),
        ("gamma", np.nan),
        ("loss", "cubic"),
        ("reset_share", 1.5),
        ("random_share", -0.5),
        ("gain_weight", -0.1),
        ("sensitivity_weight", np.nan),
        ("averaging", "much"),
        ("exploration_noise", -1.0),
        ("exploration_noise", np.inf),
        ("learning_rate", -1e-3),
        ("learning_rate", np.nan),
        ("value_learning_rate", -1e-3),
        ("value_learning_rate", "cosine_1e-3"),
    ],
)
def test_a_hyperparameter_out_of_range_is_named_with_its_range(name, argument, value):
    with pytest.raises(ValueError) as caught:
        small(name, **{argument: value})

    message = str(caught.value)
    assert repr(value) in message and ("must be" in message or "'lin_NUMBER'" in message)


@pytest.mark.parametrize(
    "argument, value",
    [
        ("temperature", -1.0),
        ("temperature_decay", 1.1),
        ("exploration_decay", -0.1),
        ("relabel_share", 2.0),
    ],
)
def test_what_only_hds_has_is_checked_too(argument, value):
    with pytest.raises(ValueError, match=rf"HDS\({argument}={value}\): {argument} must be"):
        small("hds", **{argument: value})


@every_algorithm
def test_an_unknown_argument_is_named(name):
    with pytest.raises(TypeError, match="n_rollout'"):
        small(name, n_rollout=8)
    with pytest.raises(TypeError, match="net_archs"):
        small(name, policy_kwargs={"net_archs": [8]})


@every_planner
@pytest.mark.parametrize(
    "settings, reason",
    [
        ({"net_arch": [0]}, r"net_arch must be.*got \[0\]"),
        ({"net_arch": [8.0]}, "net_arch must be"),
        ({"net_arch": {"pi": [8], "qf": [8]}}, "net_arch must be.*'pi'"),
        ({"net_arch": 8}, "net_arch must be"),
        ({"activation_fn": "sigmoids"}, "activation_fn must be one of"),
        ({"max_grad_norm": 0.0}, "max_grad_norm must be above 0"),
    ],
    ids=str,
)
def test_settings_of_the_networks_are_checked(name, settings, reason):
    with pytest.raises(ValueError, match=reason):
        small(name, policy_kwargs=settings)


@every_algorithm
def test_settings_belong_to_whoever_gave_them(name):
    """Two models that were given one dictionary are still two."""
    given = {**SMALL[name].get("policy_kwargs", {})}
    before = dict(given)

    model = small(name, policy_kwargs=given)

    assert given == before and model.policy_kwargs is not given


@every_algorithm
@pytest.mark.parametrize("device", ["cuda", "cuda:7", "warp"])
def test_a_device_that_is_not_there_is_refused_with_what_is(name, device):
    with pytest.raises(ValueError, match=rf"device='{device}'.*it has: .*cpu"):
        small(name, device=device)


@every_algorithm
def test_a_path_that_cannot_be_written_is_named_and_nothing_is_left(name, tmp_path):
    (tmp_path / "file").write_text("not a folder")

    with pytest.raises(OSError, match=r"file/model\.zip' could not be written"):
        small(name).save(tmp_path / "file" / "model")
    (tmp_path / "folder.zip").mkdir()
    with pytest.raises(OSError, match=r"folder\.zip' could not be written"):
        small(name).save(tmp_path / "folder")

    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder.zip"]
    assert (tmp_path / "file").read_text() == "not a folder"
