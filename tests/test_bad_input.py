"""What an algorithm is given by mistake: a clear error each, and nothing half-done."""

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from small_models import NAMES, PLANNERS, SMALL, small
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.her import HerReplayBuffer

from sb3_hds import algos, twins
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


# --- one line each, that says what to do ----------------------------------------------------------


FREE = {"observation": OBS, "desired_goal": OBS}
# By what is wrong: what is called, of a class and its small arguments, and what the error says.
MISTAKES = {
    "an unknown argument": (
        lambda kind, own: kind("Pendulum-v1", **own, sed=3),
        r"has no argument 'sed'\. Did you mean 'seed'\?",
    ),
    "an argument of another": (
        lambda kind, own: kind("Pendulum-v1", **own, frobnicate=1),
        r"has no argument 'frobnicate'\. It has: policy, env, ",
    ),
    "a policy and no environment": (
        lambda kind, own: kind("CnnPolicy", **own),
        "has no policy 'CnnPolicy': use MlpPolicy",
    ),
    "the environment first": (
        lambda kind, own: kind(gymnasium.make("Pendulum-v1"), "MlpPolicy", **own),
        r"that is a policy\. The policy comes first",
    ),
    "a class": (
        lambda kind, own: kind("MlpPolicy", Spaces, **own),
        "a class or function: call it first",
    ),
    "a function": (
        lambda kind, own: kind("MlpPolicy", lambda: gymnasium.make("Pendulum-v1"), **own),
        "a class or function: call it first",
    ),
    "a number": (lambda kind, own: kind("MlpPolicy", 5, **own), "that is no environment"),
    "vectors of Gymnasium": (
        lambda kind, own: kind(gymnasium.make_vec("Pendulum-v1", 2), **own),
        r"GymnasiumVecEnv\(env\)",
    ),
    "limits that overflow": (
        lambda kind, own: kind(Spaces(OBS, spaces.Box(-3e38, 3e38, (1,))), **own),
        "finite lower and upper bound.*TransformAction",
    ),
    "half a limit": (
        lambda kind, own: kind(Spaces(OBS, spaces.Box(-1.0, np.inf, (1,))), **own),
        "finite lower and upper bound.*TransformAction",
    ),
    "a seed below 0": (lambda kind, own: kind("Pendulum-v1", **own, seed=-1), "seed must be"),
    "a seed that is a word": (
        lambda kind, own: kind("Pendulum-v1", **own, seed="zero"),
        "seed must be None or a whole number from 0 to 4294967295",
    ),
    "policy_kwargs as a word": (
        lambda kind, own: kind("Pendulum-v1", **own | {"policy_kwargs": "dict()"}),
        r"policy_kwargs must be a dictionary, such as \{'net_arch'",
    ),
}


@pytest.mark.parametrize("name", ["droq", "hds", "openloop"])
@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_constructor_says_in_one_line_what_to_do_instead_of(mistake, name):
    call, said = MISTAKES[mistake]

    with pytest.raises((ValueError, TypeError), match=said) as caught:
        call(algos.ALL[name], SMALL[name])

    assert "\n" not in str(caught.value)


# By what is wrong: what is done with a model and a folder, and what the error says.
LATER = {
    "steps below 0": (lambda model, _: model.learn(-5), "whole number of steps of at least 0"),
    "half a step": (lambda model, _: model.learn(20.5), "whole number of steps of at least 0"),
    "steps as a word": (lambda model, _: model.learn("20"), "whole number of steps of at least 0"),
    "no number of steps": (lambda model, _: model.learn(np.nan), "whole number of steps"),
    "a callback that is none": (
        lambda model, _: model.learn(10, callback=5),
        "callback must be a BaseCallback of SB3, a function of locals and globals, or a list",
    ),
    "no interval": (lambda model, _: model.learn(10, log_interval=0), "log_interval must be None"),
    "another environment": (
        lambda model, _: model.set_env(gymnasium.make("MountainCarContinuous-v0")),
        "Observation spaces do not match: .*Pass one like it, or make a new model",
    ),
    "no environment": (lambda model, _: model.set_env(None), "that is no environment"),
    "an observation of nothing": (lambda model, _: model.predict(None), "which is no observation"),
    "loading for another environment": (
        lambda model, path: load(model, path, env=gymnasium.make("MountainCarContinuous-v0")),
        "Observation spaces do not match: .*Pass one like it, or make a new model",
    ),
    "loading with an unknown argument": (
        lambda model, path: load(model, path, sed=3),
        r"has no argument 'sed'\. Did you mean 'seed'\?",
    ),
    "loading nothing": (lambda model, _: type(model).load(None), "Expected the path of a file"),
    "learning without an environment": (
        lambda model, path: load(model, path).learn(10),
        r"has no environment to learn in: call set_env\(env\), or load it with one, as ",
    ),
}


def load(model, path, **arguments):
    model.save(path)
    return type(model).load(path, **arguments)


@pytest.fixture(scope="module")
def models():
    return {name: small(name) for name in ("droq", "hds", "openloop")}


@pytest.mark.parametrize("name", ["droq", "hds", "openloop"])
@pytest.mark.parametrize("mistake", LATER)
def test_a_model_says_in_one_line_what_to_do_instead_of(mistake, name, models, tmp_path):
    call, said = LATER[mistake]

    with pytest.raises((ValueError, TypeError), match=said) as caught:
        call(models[name], tmp_path / "model.zip")

    assert "\n" not in str(caught.value)
    # It is as it was.
    assert models[name].get_env() is not None and models[name].num_timesteps == 0


@pytest.mark.parametrize("name", ["droq", "td7", "hds"])
def test_hindsight_without_goals_is_refused(name):
    with pytest.raises(EnvironmentMismatchError, match=r"relabels goals: .*Leave replay_buffer"):
        small(name, replay_buffer_class=HerReplayBuffer)


def test_hindsight_with_half_of_what_it_needs_is_refused():
    with pytest.raises(EnvironmentMismatchError, match="achieved_goal"):
        env = Spaces(spaces.Dict(FREE), ACT)
        small("droq", env, policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer)


def test_a_replay_buffer_of_another_environment_is_refused_and_the_own_one_stays(tmp_path):
    model, buffer = small("droq"), tmp_path / "buffer"
    small("droq", "MountainCarContinuous-v0").save_replay_buffer(buffer)
    own = model.replay_buffer

    with pytest.raises(EnvironmentMismatchError, match="of another environment: its observation"):
        model.load_replay_buffer(buffer)
    assert model.replay_buffer is own

    # As SB3's own tests do.
    del model.replay_buffer
    small("droq").save_replay_buffer(buffer)
    model.load_replay_buffer(buffer)
    small("droq", make_vec_env("Pendulum-v1", 2)).save_replay_buffer(buffer)
    with pytest.raises(EnvironmentMismatchError, match="its n_envs is 2, this model's 1"):
        model.load_replay_buffer(buffer)


def test_updates_without_transitions_are_refused():
    with pytest.raises(ValueError, match="nothing to learn from: its replay buffer is empty"):
        small("droq").train(1, 16)


def test_a_replay_buffer_that_does_not_fit_is_refused_by_its_size():
    with pytest.raises(MemoryError, match=r"buffer_size=1\d+\): .* Pass a smaller buffer_size"):
        small("droq", buffer_size=10**13)


@pytest.mark.parametrize("given", ["1", (1, "epsiode"), 0, (1,), 1.5])
def test_how_often_to_train_is_a_number_of_steps_or_episodes(given):
    with pytest.raises(ValueError, match="train_freq must be a number of at least 1, or"):
        small("droq", train_freq=given)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"twin": 5}, "twin must be a twin"),
        ({"twin": twins.Pendulum}, "twin must be a twin"),
        ({"effects": [3]}, "effects must be a list of names"),
        ({"effects": 3}, "effects must be a list of names"),
        ({"suspected": [3]}, "suspected must be a list of names"),
    ],
)
def test_what_hds_plans_in_is_a_twin_with_effects(arguments, said):
    with pytest.raises(TypeError, match=said):
        small("hds", **arguments)


def test_a_single_effect_needs_no_list():
    assert small("hds", effects="viscous_friction").effects == ["viscous_friction"]


@pytest.mark.parametrize("name", ["droq", "hds", "openloop"])
def test_ids_round_steps_and_functions_in_lists_are_fine(name, models, tmp_path):
    model = load(models[name], tmp_path / "model", env="Pendulum-v1")
    seen = []
    steps = 24 if name == "openloop" else 25

    model.set_env("Pendulum-v1")
    model.learn(float(steps), callback=[lambda *_: seen.append(1) or True, None])

    assert model.num_timesteps == steps and seen


class Own(algos.DroQ):
    """Has arguments that its constructor takes out of those that it passes on."""

    def __init__(self, *args, **kwargs):
        self.extra = kwargs.pop("extra", None)
        super().__init__(*args, **kwargs)


def test_somebodys_own_constructor_may_take_what_it_likes():
    assert Own("Pendulum-v1", **SMALL["droq"], extra=3).extra == 3
    with pytest.raises(TypeError, match="learnin_rate"):
        Own("Pendulum-v1", **SMALL["droq"], learnin_rate=3)
