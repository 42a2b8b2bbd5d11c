"""What an algorithm is given by mistake: a clear error each, and nothing half-done."""

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from odd_envs import ACT, OBS, AnySpaces
from small_models import SMALL, saved, small
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.her import HerReplayBuffer

from sb3_hds import algos, twins
from sb3_hds.errors import EnvironmentMismatchError, NoTwinError

pytestmark = pytest.mark.usefixtures("quick_compilation")
#: one of each constructor that looks at its arguments
KINDS = ("droq", "td7", "hds", "openloop")
every_kind = pytest.mark.parametrize("name", KINDS)


@pytest.fixture(scope="module")
def models():
    return {name: small(name) for name in KINDS}


def load(model, **arguments):
    return type(model).load(saved(model), **arguments)


PENDULUM = ("Pendulum-v1",)
LIMITS = "finite lower and upper bound.*TransformAction"
# By what is wrong: what a class is called with beside its small arguments, and what it says.
# By what is wrong: what a class is called with beside its small arguments, and what it says.
MISTAKES = {
    "an unknown argument": (PENDULUM, {"sed": 3}, r"has no argument 'sed'\. Did you mean 'seed'\?"),
    "an argument of another": (PENDULUM, {"frobnicate": 1}, "no argument 'frobnicate'.*It has"),
    "no environment": ((), {}, "needs an environment"),
    "a policy alone": (("MlpPolicy",), {}, "needs an environment"),
    "an unknown environment": (("Nowhere-v0",), {}, "Nowhere"),
    "an unknown policy": (("CnnPolicy", *PENDULUM), {}, "no policy 'CnnPolicy': use MlpPolicy"),
    "the environment first": ((AnySpaces(), "MlpPolicy"), {}, "The policy comes first"),
    "a class": (("MlpPolicy", AnySpaces), {}, "a class or function: call it first"),
    "a number": (("MlpPolicy", 5), {}, "that is no environment"),
    "vectors": ((gymnasium.make_vec("Pendulum-v1", 2),), {}, r"GymnasiumVecEnv\(env\)"),
    "choices": ((AnySpaces(action_space=spaces.Discrete(3)),), {}, r"only supports.*Discrete"),
    "wide limits": ((AnySpaces(action_space=spaces.Box(-3e38, 3e38, (1,))),), {}, LIMITS),
    "a seed below 0": (PENDULUM, {"seed": -1}, "seed must be"),
    "a seed that is a word": (PENDULUM, {"seed": "zero"}, "seed must be None or a whole number"),
    "policy_kwargs as a word": (PENDULUM, {"policy_kwargs": "dict()"}, "must be a dictionary"),
    "a device that is not there": (PENDULUM, {"device": "cuda:7"}, "'cuda:7'.*it has: .*cpu"),
}
REFUSED = (ValueError, TypeError, AssertionError, gymnasium.error.NameNotFound)


@every_kind
@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_constructor_says_in_one_line_what_to_do_instead_of(mistake, name):
    arguments, named, said = MISTAKES[mistake]

    with pytest.raises(REFUSED, match=said) as caught:
        algos.ALL[name](*arguments, **SMALL[name] | named)

    assert "\n" not in str(caught.value)


# By what is wrong: what is done with a model, and what the error says.
# By what is wrong: what is done with a model, and what the error says.
CAR = "MountainCarContinuous-v0"
LATER = {
    "steps below 0": (lambda model: model.learn(-5), "whole number of steps of at least 0"),
    "half a step": (lambda model: model.learn(20.5), "whole number of steps of at least 0"),
    "steps as a word": (lambda model: model.learn("20"), "whole number of steps of at least 0"),
    "a callback that is none": (lambda model: model.learn(10, callback=5), "callback must be a"),
    "no interval": (lambda model: model.learn(10, log_interval=0), "log_interval must be None"),
    "another environment": (
        lambda model: model.set_env(gymnasium.make(CAR)),
        "Observation spaces do not match: .*Pass one like it",
    ),
    "no environment": (lambda model: model.set_env(None), "that is no environment"),
    "an observation of nothing": (lambda model: model.predict(None), "which is no observation"),
    "observations with an axis more": (lambda model: model.predict(np.zeros((2, 3, 1))), "shape"),
    "no number": (lambda model: model.predict(np.array([1.0, 0.0, np.nan])), "not finite"),
    "what reset returns": (lambda model: model.predict((np.zeros(3), {})), "mixing Gym API"),
    "loading for another environment": (
        lambda model: load(model, env=gymnasium.make(CAR)),
        "Observation spaces do not match: .*Pass one like it",
    ),
    "loading with an unknown argument": (lambda model: load(model, sed=3), "Did you mean 'seed'"),
    "loading nothing": (lambda model: type(model).load(None), "Expected the path of a file"),
    "learning without an environment": (
        lambda model: load(model).learn(10),
        r"has no environment to learn in: call set_env\(env\), or load it with one, as ",
    ),
}


@every_kind
@pytest.mark.parametrize("mistake", LATER)
def test_a_model_says_what_to_do_instead_of(mistake, name, models):
    call, said = LATER[mistake]

    with pytest.raises((ValueError, TypeError), match=said) as caught:
        call(models[name])

    assert "\n" not in str(caught.value)
    # It is as it was.
    assert models[name].get_env() is not None and models[name].num_timesteps == 0


@pytest.mark.parametrize("name", ["droq", "openloop"])
def test_ids_round_steps_and_functions_in_lists_are_fine(name, models):
    model = load(models[name], env="Pendulum-v1")
    seen = []
    steps = 24 if name == "openloop" else 25

    model.set_env("Pendulum-v1")
    model.learn(float(steps), callback=[lambda *_: seen.append(1) or True, None])

    assert model.num_timesteps == steps and seen


@every_kind
def test_settings_belong_to_whoever_gave_them(name):
    given = {**SMALL[name].get("policy_kwargs", {})}
    before = dict(given)

    model = small(name, policy_kwargs=given)

    assert given == before and model.policy_kwargs is not given


@every_kind
def test_a_path_that_cannot_be_written_is_named_and_nothing_is_left(name, models, tmp_path):
    (tmp_path / "file").write_text("not a folder")

    with pytest.raises(OSError, match=r"file/model\.zip' could not be written"):
        models[name].save(tmp_path / "file" / "model")
    (tmp_path / "folder.zip").mkdir()
    with pytest.raises(OSError, match=r"folder\.zip' could not be written"):
        models[name].save(tmp_path / "folder")

    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder.zip"]
    assert (tmp_path / "file").read_text() == "not a folder"


# --- planning in a twin ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "space", [spaces.Dict({"a": OBS}), spaces.Discrete(5), spaces.Box(-1.0, 1.0, (3, 2))]
)
def test_observations_that_no_twin_has_are_refused(space):
    with pytest.raises(EnvironmentMismatchError, match="A twin observes a Box with one axis"):
        small("hds", AnySpaces(space))


def test_an_environment_without_a_twin_is_told_what_has_one_and_how_to_add_one():
    with pytest.raises(NoTwinError, match=r"'AnySpaces'(.|\n)*Pendulum-v1(.|\n)*twins\.register"):
        small("hds", AnySpaces())


def test_a_twin_of_another_system_is_refused():
    with pytest.raises(EnvironmentMismatchError, match="MountainCar"):
        small("hds", twin="MountainCar")
    with pytest.raises(NoTwinError, match="Did you mean 'Pendulum'"):
        small("hds", twin="Pendulun")


@pytest.mark.parametrize(
    "argument, value",
    [
        ("n_rollouts", 8.5),
        ("horizon", 0),
        ("lookahead", -1),
        ("order", 3),
        ("planner", "best"),
        ("n_iterations", 0),
        ("n_step_sizes", 1),
        ("n_random_plans", -1),
        ("plan_memory", 0),
        ("pretrain_epochs", None),
        ("gradient_steps", -2),
        ("gamma", 1.01),
        ("loss", "cubic"),
        ("reset_share", 1.5),
        ("gain_weight", -0.1),
        ("sensitivity_weight", np.nan),
        ("averaging", "much"),
        ("exploration_noise", np.inf),
        ("learning_rate", -1e-3),
        ("value_learning_rate", "cosine_1e-3"),
        ("temperature", -1.0),
        ("temperature_decay", 1.1),
        ("relabel_share", 2.0),
    ],
)
def test_a_hyperparameter_out_of_range_is_named_with_its_range(argument, value):
    with pytest.raises(ValueError, match=r"must be|'lin_NUMBER'") as caught:
        small("hds", **{argument: value})

    assert repr(value) in str(caught.value)


@pytest.mark.parametrize(
    "settings, reason",
    [
        ({"net_arch": [0]}, r"net_arch must be.*got \[0\]"),
        ({"net_arch": [8.0]}, "net_arch must be"),
        ({"net_arch": {"pi": [8], "qf": [8]}}, "net_arch must be.*'pi'"),
        ({"activation_fn": "sigmoids"}, "activation_fn must be one of"),
        ({"max_grad_norm": 0.0}, "max_grad_norm must be above 0"),
    ],
    ids=str,
)
def test_settings_of_the_networks_are_checked(settings, reason):
    with pytest.raises(ValueError, match=reason):
        small("hds", policy_kwargs=settings)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"twin": twins.Pendulum}, "twin must be a twin"),
        ({"effects": [3]}, "effects must be a list of names"),
        ({"suspected": 3}, "suspected must be a list of names"),
    ],
)
def test_what_hds_plans_in_is_a_twin_with_effects(arguments, said):
    with pytest.raises(TypeError, match=said):
        small("hds", **arguments)
    assert small("hds", effects="viscous_friction").effects == ["viscous_friction"]


# --- replay ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["droq", "td7", "hds"])
def test_hindsight_without_goals_is_refused(name):
    with pytest.raises(EnvironmentMismatchError, match=r"relabels goals: .*Leave replay_buffer"):
        small(name, replay_buffer_class=HerReplayBuffer)
    env = AnySpaces(spaces.Dict({"observation": OBS, "desired_goal": OBS}), ACT)
    if name == "droq":
        with pytest.raises(EnvironmentMismatchError, match="achieved_goal"):
            small(name, env, policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer)


def test_a_replay_buffer_of_another_environment_is_refused_and_the_own_one_stays(tmp_path):
    model, buffer = small("droq"), tmp_path / "buffer"
    small("droq", CAR).save_replay_buffer(buffer)
    own = model.replay_buffer

    with pytest.raises(EnvironmentMismatchError, match="of another environment: its observation"):
        model.load_replay_buffer(buffer)
    assert model.replay_buffer is own
    small("droq", make_vec_env("Pendulum-v1", 2)).save_replay_buffer(buffer)
    with pytest.raises(EnvironmentMismatchError, match="its n_envs is 2, this model's 1"):
        model.load_replay_buffer(buffer)
    with pytest.raises(MemoryError, match=r"buffer_size=1\d+\): .* Pass a smaller buffer_size"):
        small("droq", buffer_size=10**13)


@pytest.mark.parametrize("given", ["1", (1, "epsiode"), (-1, "episode"), 1.5])
def test_how_often_to_train_is_a_number_of_steps_or_episodes(given, models):
    with pytest.raises(ValueError, match="train_freq must be a number of at least 1, or"):
        small("droq", train_freq=given)
    with pytest.raises(ValueError, match="nothing to learn from: its replay buffer is empty"):
        models["droq"].train(1, 16)


class Own(algos.DroQ):
    """Has arguments that its constructor takes out of those that it passes on."""

    def __init__(self, *args, **kwargs):
        self.extra = kwargs.pop("extra", None)
        super().__init__(*args, **kwargs)


def test_somebodys_own_constructor_may_take_what_it_likes():
    assert Own("Pendulum-v1", **SMALL["droq"], extra=3).extra == 3
    with pytest.raises(TypeError, match="learnin_rate"):
        Own("Pendulum-v1", **SMALL["droq"], learnin_rate=3)
