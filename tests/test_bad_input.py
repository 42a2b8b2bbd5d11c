"""What an algorithm is given by mistake: a clear error each, and nothing half-done."""

import gymnasium
import numpy as np
import pytest
from cases import each
from gymnasium import spaces
from odd_envs import ACT, OBS, AnySpaces
from small_models import SMALL, saved, small
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.her import HerReplayBuffer

from sb3_hds import algos, twins
from sb3_hds.errors import EnvironmentMismatchError, NoTwinError

#: one of each constructor that looks at its arguments
KINDS = ("droq", "td7", "hds", "openloop")
every_kind = pytest.mark.parametrize("name", KINDS)


def asked_of_each(mistakes, *of_all):
    """:return: cases: all mistakes are made with one algorithm, and some with every kind"""
    return [(m, name) for m in mistakes for name in KINDS if m in of_all or name == "droq"]


@pytest.fixture(scope="module")
def models():
    return {name: small(name) for name in KINDS}


def load(model, **arguments):
    return type(model).load(saved(model), **arguments)


PENDULUM = ("Pendulum-v1",)
LIMITS = "finite lower and upper bound.*TransformAction"
# By what is wrong: what a class is called with beside its small arguments, and what it says.
MISTAKES = {
    "an unknown argument": (PENDULUM, {"sed": 3}, r"has no argument 'sed'\. Did you mean 'seed'\?"),
    "a policy alone": (("MlpPolicy",), {}, "needs an environment"),
    "an unknown environment": (("Nowhere-v0",), {}, "Nowhere"),
    "an unknown policy": (("CnnPolicy", *PENDULUM), {}, "no policy 'CnnPolicy': use MlpPolicy"),
    "the environment first": ((AnySpaces(), "MlpPolicy"), {}, "The policy comes first"),
    "a class": (("MlpPolicy", AnySpaces), {}, "a class or function: call it first"),
    "vectors": ((gymnasium.make_vec("Pendulum-v1", 2),), {}, r"GymnasiumVecEnv\(env\)"),
    "choices": ((AnySpaces(action_space=spaces.Discrete(3)),), {}, r"only supports.*Discrete"),
    "wide limits": ((AnySpaces(action_space=spaces.Box(-3e38, 3e38, (1,))),), {}, LIMITS),
    "a seed below 0": (PENDULUM, {"seed": -1}, "seed must be"),
    "a seed that is a word": (PENDULUM, {"seed": "zero"}, "seed must be None or a whole number"),
    "policy_kwargs as a word": (PENDULUM, {"policy_kwargs": "dict()"}, "must be a dictionary"),
    "policy_kwargs as a list": (PENDULUM, {"policy_kwargs": []}, "policy_kwargs must be a dict"),
    "policy_kwargs as a number": (PENDULUM, {"policy_kwargs": 0}, "policy_kwargs must be a dict"),
    "a truth value as a number": (PENDULUM, {"batch_size": True}, "batch_size must be a whole"),
    "no learning rate": (PENDULUM, {"learning_rate": None}, "learning_rate must be a finite"),
    "a list of learning rates": (PENDULUM, {"learning_rate": [1e-3]}, "or a schedule"),
    "no such device": (PENDULUM, {"device": "cuda:7"}, "'cuda:7'.*it has: .*cpu"),
}
REFUSED = (ValueError, TypeError, AssertionError, gymnasium.error.NameNotFound)


@pytest.mark.parametrize(
    ("mistake", "name"),
    asked_of_each(MISTAKES, "an unknown argument", "a class", "choices", "no such device"),
)
def test_a_constructor_says_in_one_line_what_to_do_instead_of(mistake, name):
    arguments, named, said = MISTAKES[mistake]
    with pytest.raises(REFUSED, match=said) as caught:
        algos.ALL[name](*arguments, **SMALL[name] | named)
    assert "\n" not in str(caught.value)


# By what is wrong: what is done with a model, and what the error says.
CAR = "MountainCarContinuous-v0"
LATER = {
    "steps below 0": (lambda model: model.learn(-5), "whole number of steps of at least 0"),
    "half a step": (lambda model: model.learn(20.5), "whole number of steps of at least 0"),
    "a callback that is none": (lambda model: model.learn(10, callback=5), "callback must be a"),
    "no interval": (lambda model: model.learn(10, log_interval=0), "log_interval must be None"),
    "another environment": (lambda model: model.set_env(gymnasium.make(CAR)), "Pass one like it"),
    "an observation of nothing": (lambda model: model.predict(None), "which is no observation"),
    "observations with an axis more": (lambda model: model.predict(np.zeros((2, 3, 1))), "shape"),
    "no number": (lambda model: model.predict(np.array([1.0, 0.0, np.nan])), "not finite"),
    "what reset returns": (lambda model: model.predict((np.zeros(3), {})), "mixing Gym API"),
    "loading for another": (lambda model: load(model, env=CAR), "spaces do not match: .*like it"),
    "loading with a typo": (lambda model: load(model, sed=3), "Did you mean 'seed'"),
    "nowhere to learn": (lambda model: load(model).learn(10), r"call set_env\(env\), or load it"),
}


@pytest.mark.parametrize(
    ("mistake", "name"),
    asked_of_each(LATER, "half a step", "another environment", "no number", "loading with a typo"),
)
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
    seen, steps = [], 24 if name == "openloop" else 25
    model.learn(float(steps), callback=[lambda *_: seen.append(1) or True, None])
    assert model.num_timesteps == steps and seen


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


@each(
    ({"n_rollouts": 8.5}, "n_rollouts must be a whole number.*1"),
    ({"lookahead": -1}, "lookahead must be a whole number of at least 0"),
    ({"planner": "lqr"}, "planner must be one of"),
    ({"gamma": 1.01}, "gamma must be a number above 0 and at most 1"),
    ({"reset_share": 1.5}, "reset_share must be a number from 0 to 1"),
    ({"exploration_noise": np.inf}, "exploration_noise must be a finite number"),
    ({"learning_rate": "cosine_1e-3"}, "'lin_NUMBER'"),
    ({"policy_kwargs": {"net_arch": [0]}}, r"net_arch must be.*got \[0\]"),
    ({"policy_kwargs": {"net_arch": {"pi": [8], "qf": [8]}}}, "net_arch must be.*'pi'"),
    ({"policy_kwargs": {"activation_fn": "sigmoids"}}, "activation_fn must be one of"),
    ({"policy_kwargs": {"max_grad_norm": 0.0}}, "max_grad_norm must be above 0"),
    ({"env": AnySpaces(spaces.Dict({"a": OBS}))}, "A twin observes a Box with one axis"),
    ({"env": AnySpaces()}, r"'AnySpaces'(.|\n)*Pendulum-v1(.|\n)*twins\.register"),
    ({"twin": "MountainCar"}, "MountainCar"),
    ({"twin": "Pendulun"}, "Did you mean 'Pendulum'"),
    ({"twin": twins.Pendulum}, "twin must be a twin"),
    ({"effects": [3]}, "effects must be a list of names"),
)
def test_what_planning_cannot_use_is_named_with_what_it_may_be(arguments, said):
    with pytest.raises((ValueError, TypeError, NoTwinError), match=said):
        small("hds", **arguments)


def test_hindsight_without_goals_is_refused():
    with pytest.raises(EnvironmentMismatchError, match=r"relabels goals: .*Leave replay_buffer"):
        small("droq", replay_buffer_class=HerReplayBuffer)
    env = AnySpaces(spaces.Dict({"observation": OBS, "desired_goal": OBS}), ACT)
    with pytest.raises(EnvironmentMismatchError, match="achieved_goal"):
        small("droq", env, policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer)


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


@pytest.mark.parametrize("given", ["1", (1, "epsiode"), (-1, "episode")])
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


def test_a_users_algorithm_may_have_its_own_constructor_and_keeps_its_settings():
    given = {"net_arch": [8]}
    model = Own("Pendulum-v1", **SMALL["droq"] | {"policy_kwargs": given}, extra=3)

    assert model.extra == 3 and given == {"net_arch": [8]} and model.policy_kwargs is not given
    with pytest.raises(TypeError, match="learnin_rate"):
        Own("Pendulum-v1", **SMALL["droq"], learnin_rate=3)
