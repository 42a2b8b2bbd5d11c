"""Two updates of every model-free algorithm beside plain NumPy, weight by weight."""

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces
from numpy_networks import (
    Adam,
    Weights,
    average_l1,
    bro,
    dense,
    descend,
    elu,
    gaussian,
    layer_norm,
    member,
    mlp,
    quantile_huber,
    relu,
    simba,
    slope,
    squashed,
    squashed_between,
)
from odd_envs import AnySpaces

from sb3_hds import algos
from sb3_hds.algos.model_free.replay import Batch
from sb3_hds.algos.model_free.sac.networks import Dropout
from sb3_hds.algos.model_free.sac.update import Hyperparams, UpdateMetrics, mean_values, update
from sb3_hds.algos.model_free.td7 import update as td7_update
from sb3_hds.algos.model_free.update import zero_metrics
from sb3_hds.algos.nets.observations import RunningStats

pytestmark = pytest.mark.usefixtures("x64")

N_OBS, N_ACT, N_BATCH, N_UPDATES = 3, 2, 6, 2
HYPER = Hyperparams(learning_rate=0.03, qf_learning_rate=0.05, tau=0.1, target_entropy=-1.3)
# Double precision, and slopes whose error is that of a central difference.
CLOSE: dict[str, Any] = {"rtol": 1e-6, "atol": 1e-8}
# NormalTanhPolicy of the authors of SimBa and of BRO.
OF_AUTHORS = partial(gaussian, log_std_of=partial(squashed_between, low=-10.0, high=2.0))


def begun(name: str, policy_kwargs: dict[str, Any] | None = None, **arguments: Any) -> Any:
    """Config and state in double precision: no bias is zero, and no two networks are equal."""
    kwargs = {"net_arch": [4], "optimizer_class": "sgd"} | (policy_kwargs or {})
    env = AnySpaces(action_space=spaces.Box(-1.0, 1.0, (N_ACT,)))
    model = algos.ALL[name](env=env, seed=0, buffer_size=10, policy_kwargs=kwargs, **arguments)
    rng = np.random.default_rng(1)

    def doubled(path: Any, leaf: Any) -> Any:
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            return leaf
        weight = any(getattr(step, "key", None) == "params" for step in path) and leaf.ndim > 0
        moved = 0.2 * rng.normal(size=leaf.shape) if weight else 0.0
        return jnp.asarray(np.asarray(leaf, np.float64) + moved)

    return model.policy.update_config, jax.tree_util.tree_map_with_path(
        doubled, model.policy.agent_state
    )


def plain(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: np.array(leaf, np.float64), tree)


def batches(n_updates: int = N_UPDATES, seed: int = 0) -> Batch:
    rng = np.random.default_rng(seed)
    draw = lambda *shape: rng.normal(size=(n_updates, N_BATCH, *shape))  # noqa: E731
    return Batch(
        obs=draw(N_OBS),
        action=np.tanh(draw(N_ACT)),
        next_obs=draw(N_OBS),
        reward=3.0 * draw(),
        terminated=(draw() > 0.7).astype(float),
        discount=np.full((n_updates, N_BATCH), 0.9),
    )


def assert_same(found: Any, expected: Any) -> None:
    leaves, structure = jax.tree_util.tree_flatten_with_path(expected)
    assert jax.tree.structure(found) == structure
    for (path, leaf), other in zip(leaves, jax.tree.leaves(found), strict=True):
        np.testing.assert_allclose(other, leaf, err_msg=str(path), **CLOSE)


class Keys(NamedTuple):
    """Of one update: two of noise, three of dropout masks, and what else there is."""

    next_action: Any
    critic: Any
    next_critic: Any
    action: Any
    critic_of_actor: Any
    extra: Any


def keys_of(state: Any) -> Iterator[Keys]:
    key = state.key
    while True:
        key, critic_key, actor_key = jax.random.split(key, 3)
        yield Keys(*jax.random.split(critic_key, 3), *jax.random.split(actor_key, 3))


def normal(key: Any) -> np.ndarray:
    return np.asarray(jax.random.normal(key, (N_BATCH, N_ACT)))


class Soft:
    """
    Soft actor-critic (Haarnoja et al. 2018): equations 5 to 9 and 18 of arXiv 1812.05905.

    :param target_of: next values ``(critics, batch, values)`` to targets ``(batch, targets)``
    :param worth: values of all critics to what the actor climbs
    :param linear: whether the loss of the entropy coefficient has it itself, not its logarithm
    """

    gaussian = staticmethod(gaussian)

    policy_delay = target_every = 1  # updates of the critics for each of the actor and of targets

    def __init__(self, state, body, target_of, error, worth, b1=0.9, linear=False) -> None:
        self.linear = linear
        self.body, self.target_of, self.error, self.worth = body, target_of, error, worth
        self.actor = plain(state.actor.weights["params"])
        self.critic = plain(state.critic.weights["params"])
        self.target = plain(state.target["params"])
        self.log_ent_coef = float(state.log_ent_coef.weights["params"])
        self.adam = Adam(HYPER.learning_rate, b1)
        self.keys, self.n, self.report = keys_of(state), 0, {}

    def values(self, critic: Weights, obs: np.ndarray, action: np.ndarray, key: Any) -> np.ndarray:
        both = np.concatenate([obs, action], -1)
        each = [member(critic, i) for i in range(len(critic["Dense_0"]["kernel"]))]
        return np.stack([dense(w["Dense_0"], self.body(w["body"], both)) for w in each])

    def next_values(self, batch: Batch, next_action: np.ndarray, key: Any) -> np.ndarray:
        return self.values(self.target, batch.next_obs, next_action, key)

    def predicted(self, critic: Weights, batch: Batch, next_action: Any, key: Any) -> np.ndarray:
        return self.values(critic, batch.obs, batch.action, key)

    def acts(self, actor: Weights, obs: np.ndarray, noise: Any, training: bool = True) -> Any:
        return squashed(*self.gaussian(actor, self.body(actor["body"], obs)), noise)

    def update(self, batch: Batch) -> dict[str, float]:
        keys, self.n = next(self.keys), self.n + 1
        ent_coef, noise = np.exp(self.log_ent_coef), normal(keys.action)
        drawn = normal(keys.next_action)
        next_action, log_prob = self.acts(self.actor, batch.next_obs, drawn, training=False)
        chosen = self.target_of(self.next_values(batch, next_action, keys.next_critic))
        alive = (batch.discount * (1.0 - batch.terminated))[:, None]
        y = batch.reward[:, None] + alive * (chosen - ent_coef * log_prob[:, None])

        def critic_loss(critic: Weights) -> float:
            values = self.predicted(critic, batch, next_action, keys.critic)
            return sum(self.error(v, y) for v in values)

        def actor_loss(actor: Weights) -> float:
            action, log_prob = self.acts(actor, batch.obs, noise)
            worth = self.worth(self.values(self.critic, batch.obs, action, keys.critic_of_actor))
            return np.mean(ent_coef * log_prob - worth)

        self.report["critic_loss"] = critic_loss(self.critic)
        self.critic = descend(critic_loss, self.critic, HYPER.qf_learning_rate)
        if self.n % self.target_every == 0:
            self.follow()
        if self.n % self.policy_delay:
            return self.report
        self.report |= {"actor_loss": actor_loss(self.actor), "ent_coef": ent_coef}
        excess = -self.acts(self.actor, batch.obs, noise)[1].mean() - HYPER.target_entropy
        # Of the loss, by the logarithm.
        rise = ent_coef * excess if self.linear else excess
        self.report["ent_coef_loss"] = rise if self.linear else self.log_ent_coef * excess
        self.actor = descend(actor_loss, self.actor, HYPER.learning_rate)
        self.log_ent_coef = self.adam.step(self.log_ent_coef, rise)
        self.explore(batch, keys.extra)
        return self.report

    def follow(self) -> None:
        nearer = lambda old, new: (1.0 - HYPER.tau) * old + HYPER.tau * new  # noqa: E731
        self.target = jax.tree.map(nearer, self.target, self.critic)

    def explore(self, batch: Batch, key: Any) -> None: ...


def check(config, state, expected, seen=lambda obs: obs, n=N_UPDATES, seed=0) -> Any:
    """:return: the state after as many updates as the reference makes, which agree with it"""
    given = batches(n, seed)
    state, report = update(config, state, given, n, HYPER, zero_metrics(UpdateMetrics))
    for i in range(n):
        batch = jax.tree.map(lambda x, i=i: np.array(x[i]), given)
        said = expected.update(batch._replace(obs=seen(batch.obs), next_obs=seen(batch.next_obs)))
    assert_same(report._asdict(), said)
    assert_same(state.critic.weights["params"], expected.critic)
    assert_same(state.actor.weights["params"], expected.actor)
    assert_same(state.log_ent_coef.weights["params"], expected.log_ent_coef)
    if not config.joint_pass:
        assert_same(state.target["params"], expected.target)
    return state


def half_square(values: np.ndarray, y: np.ndarray) -> float:
    return 0.5 * np.mean((values - y) ** 2)


def least(values: np.ndarray) -> np.ndarray:
    return values.min(0)


def least_worth(values: np.ndarray) -> np.ndarray:
    return values.min(0)[:, 0]


def mean_worth(values: np.ndarray) -> np.ndarray:
    return values.mean((0, 2))


def test_soft_actor_critic_with_state_dependent_noise():
    config, state = begun("gsde_sac", {"log_std_init": -1.0})
    check(config, state, Soft(state, mlp, least, half_square, least_worth))


def test_actors_and_target_networks_may_be_updated_less_often():
    delays = {"policy_delay": 2, "target_update_interval": 3}
    config, state = begun("droq", {"dropout_rate": 0.0}, ent_coef="auto_0.3", **delays)
    expected = Soft(state, mlp, least, half_square, mean_worth)
    expected.policy_delay, expected.target_every = 2, 3

    check(config, state, expected, n=3)


class Dropped(Soft):
    """Dropout before layer norm (Hiraoka et al. 2022, figure 1), in every pass of the critics."""

    rate = 0.3

    def __init__(self, state, masks) -> None:
        super().__init__(state, mlp, least, half_square, mean_worth)
        self.masks = masks

    def values(self, critic: Weights, obs: np.ndarray, action: np.ndarray, key: Any) -> np.ndarray:
        found, both = [], np.concatenate([obs, action], -1)
        for i, keep in enumerate(self.masks(critic, obs, action, key)):
            w = member(critic, i)
            x = dense(w["body"]["Dense_0"], both) * keep / (1.0 - self.rate)
            found.append(dense(w["Dense_0"], relu(layer_norm(w["body"]["LayerNorm_0"], x))))
        return np.stack(found)


def test_droq_drops_out_in_every_pass_of_its_critics_each_with_a_mask_of_its_own():
    config, state = begun("droq", {"dropout_rate": Dropped.rate}, policy_delay=1)
    drawn = {}

    def masks(critic: Weights, obs: np.ndarray, action: np.ndarray, key: Any) -> np.ndarray:
        """What is not zero after dropout, seen once: it is the same for all weights."""
        name = np.asarray(jax.random.key_data(key)).tobytes()
        if name not in drawn:
            seen = partial(_after_dropout, config.critic, obs, action)
            drawn[name] = np.asarray(jax.vmap(seen)(critic, jax.random.split(key, 2))) != 0.0
        return drawn[name]

    check(config, state, Dropped(state, masks))

    # Three passes of two critics in each update; masks of 24 entries agree by chance in none.
    kept = [mask for both in drawn.values() for mask in both]
    assert len(kept) == 6 * N_UPDATES and len({mask.tobytes() for mask in kept}) == len(kept)


def _after_dropout(critic: Any, obs: Any, action: Any, w: Weights, key: Any) -> Any:
    is_dropout = lambda module, _: isinstance(module, Dropout)  # noqa: E731
    how = {"capture_intermediates": is_dropout, "mutable": ["intermediates"]}
    _, seen = critic.apply({"params": w}, obs, action, rngs={"dropout": key}, **how)
    return seen["intermediates"]["body"]["Dropout_0"]["__call__"][0]


def test_tqc_drops_the_largest_of_all_quantiles():
    kwargs = {"n_quantiles": 5, "n_critics": 3, "log_std_init": -1.0}
    drop = {"top_quantiles_to_drop_per_net": 2}
    config, state = begun("tqc_jax", kwargs, use_sde=True, train_freq=8, **drop)

    def kept(values: np.ndarray) -> np.ndarray:
        return np.sort(np.concatenate([*values], -1))[:, : 3 * 3]

    check(config, state, Soft(state, mlp, kept, quantile_huber, mean_worth))


def test_simba_normalises_by_all_it_saw():
    config, state = begun("simba", {"n_critics": 1}, clipped_double_q=False)
    assert config.target_values is mean_values
    rows = np.random.default_rng(2).normal([3.0, -1.0, 0.0], [2.0, 0.1, 5.0], (40, N_OBS))
    state = state._replace(
        obs_stats=RunningStats.empty(N_OBS).with_more(rows[:7]).with_more(rows[7:])
    )
    state = state._replace(obs_stats=jax.tree.map(lambda x: jnp.asarray(x, float), state.obs_stats))
    # Statistics are kept in single precision.
    np.testing.assert_allclose(state.obs_stats.variance, rows.var(0), rtol=1e-6)
    mean, variance = plain(state.obs_stats.mean), plain(state.obs_stats.variance)
    expected = Soft(state, simba, lambda v: v.mean(0), half_square, mean_worth, linear=True)
    expected.gaussian = OF_AUTHORS

    check(config, state, expected, lambda obs: (obs - mean) / np.sqrt(variance + 1e-8))


class Optimistic(Soft):
    """Nauman et al., NeurIPS 2024, section 3: the actor that explores, and its two multipliers."""

    def __init__(self, state) -> None:
        target_of = lambda values: values.mean(0)  # noqa: E731
        super().__init__(state, bro, target_of, quantile_huber, mean_worth, b1=0.5, linear=True)
        self.shift = plain(state.extra["actor"].weights["params"])
        self.gaussian = OF_AUTHORS
        # As Adjustment of the authors has them.
        self.raw_optimism, self.raw_regularizer = (
            np.arctanh((np.log(start) + 10.0) / 8.75 - 1.0) for start in (1.0, 0.25)
        )
        self.adams = tuple(Adam(0.1 * HYPER.learning_rate, 0.5) for _ in range(2))

    @staticmethod
    def multiplier(raw: Any) -> Any:
        return np.exp(squashed_between(raw, -10.0, 7.5))

    def explore(self, batch: Batch, key: Any) -> None:
        noise = normal(jax.random.split(key)[0])
        mean, std = self.gaussian(self.actor, self.body(self.actor["body"], batch.obs))
        optimism = self.multiplier(self.raw_optimism)
        regularizer = self.multiplier(self.raw_regularizer)

        def moved(w: Weights) -> np.ndarray:
            inside = np.concatenate([batch.obs, mean], -1)
            return dense(w["Dense_0"], self.body(w["body"], inside))

        def divergence(w: Weights) -> float:
            """Kullback-Leibler, of Gaussians of equal deviation."""
            return np.mean(np.sum(moved(w) ** 2 / (2.0 * std**2), -1))

        def loss(w: Weights) -> float:
            action = np.tanh(mean + moved(w) + 0.75 * std * noise)
            one, other = self.values(self.critic, batch.obs, action, None)
            upper = (one + other) / 2.0 + optimism * np.abs(one - other) / 2.0
            return regularizer * divergence(w) - upper.mean()

        excess = divergence(self.shift) / N_ACT - 0.05
        self.shift = descend(loss, self.shift, HYPER.learning_rate)
        of_optimism, of_regularizer = self.adams
        rise = lambda raw: slope(self.multiplier, raw)  # noqa: E731
        self.raw_optimism = of_optimism.step(self.raw_optimism, excess * rise(self.raw_optimism))
        down = -excess * rise(self.raw_regularizer)
        self.raw_regularizer = of_regularizer.step(self.raw_regularizer, down)


def test_bro_regresses_and_climbs_means_and_explores_by_another_actor():
    config, state = begun("bro", {"n_quantiles": 5})
    # Deviations near e^-1: the divergence goes by their square, and this is plain gradient descent.
    of_std = state.actor.weights["params"]["Dense_1"]
    of_std |= {"kernel": 0.1 * of_std["kernel"], "bias": of_std["bias"] + 0.6}
    expected = Optimistic(state)

    # With the batches of seed 0, a unit of a critic is so near its kink that differences cross it.
    state = check(config, state, expected, seed=1)

    assert_same(state.extra["actor"].weights["params"], expected.shift)
    assert_same(state.extra["optimism"].weights["params"], expected.raw_optimism)
    assert_same(state.extra["regularizer"].weights["params"], expected.raw_regularizer)


class Renormed:
    """A hidden layer between two batch renormalisations (Ioffe 2017, algorithm 1)."""

    def __init__(self, statistics: Weights) -> None:
        self.statistics, self.warm = statistics, False
        self.corrections: dict[str, Any] = {}
        self.of_batch: dict[str, Any] = {}

    def running(self, w: Weights, x: np.ndarray) -> np.ndarray:
        return self._layers(w, x, self._by_statistics)

    def training(self, w: Weights, x: np.ndarray) -> np.ndarray:
        """Corrections are those of the first call since :meth:`remember`: they have no slope."""
        return self._layers(w, x, self._by_batch)

    def remember(self, momentum: float) -> None:
        """What the first pass saw goes into the running statistics."""
        for name, found in self.of_batch.items():
            for key, value in found.items():
                old = self.statistics[name][key]
                self.statistics[name][key] = momentum * old + (1.0 - momentum) * value
        self.corrections, self.of_batch, self.warm = {}, {}, True

    def _layers(self, w: Weights, x: np.ndarray, normalise: Any) -> np.ndarray:
        x = normalise("BatchRenorm_0", w, x)
        return normalise("BatchRenorm_1", w, relu(dense(w["Dense_0"], x)))

    def _by_statistics(self, name: str, w: Weights, x: np.ndarray) -> np.ndarray:
        held = self.statistics[name]
        x = (x - held["mean"]) / np.sqrt(held["var"] + 1e-3)
        return x * w[name]["scale"] + w[name]["bias"]

    def _by_batch(self, name: str, w: Weights, x: np.ndarray) -> np.ndarray:
        mean, var, held = x.mean(0), x.var(0), self.statistics[name]
        now, running = np.sqrt(var + 1e-3), np.sqrt(held["var"] + 1e-3)
        if name not in self.of_batch:
            r = np.clip(now / running, 1.0 / 3.0, 3.0)
            d = np.clip((mean - held["mean"]) / running, -5.0, 5.0)
            self.corrections[name] = (r, d) if self.warm else (1.0, 0.0)
            self.of_batch[name] = {"mean": mean, "var": var}
        r, d = self.corrections[name]
        return ((x - mean) / now * r + d) * w[name]["scale"] + w[name]["bias"]


class Joint(Soft):
    """Bhatt et al., ICLR 2024, section 3: no target networks, one pass over both pairs."""

    momentum = 0.9

    def __init__(self, state) -> None:
        alone = state._replace(target={"params": {}})
        super().__init__(alone, None, least, half_square, least_worth, linear=True)
        statistics = plain(state.critic.weights["statistics"]["body"])
        self.of_critics = [Renormed(member(statistics, i)) for i in range(2)]
        self.of_actor = Renormed(plain(state.actor.weights["statistics"]["body"]))

    def judged(self, critic: Weights, obs: Any, action: Any, how: str) -> np.ndarray:
        both, values = np.concatenate([obs, action], -1), []
        for i, layer in enumerate(self.of_critics):
            w = member(critic, i)
            values.append(dense(w["Dense_0"], getattr(layer, how)(w["body"], both)))
        return np.stack(values)

    def values(self, critic: Weights, obs: Any, action: Any, key: Any) -> np.ndarray:
        return self.judged(critic, obs, action, "running")

    def of_both(self, critic: Weights, batch: Batch, next_action: Any) -> np.ndarray:
        obs = np.concatenate([batch.obs, batch.next_obs])
        return self.judged(critic, obs, np.concatenate([batch.action, next_action]), "training")

    def next_values(self, batch: Batch, next_action: Any, key: Any) -> np.ndarray:
        return self.of_both(self.critic, batch, next_action)[:, N_BATCH:]

    def predicted(self, critic: Weights, batch: Batch, next_action: Any, key: Any) -> np.ndarray:
        return self.of_both(critic, batch, next_action)[:, :N_BATCH]

    def acts(self, actor: Weights, obs: Any, noise: Any, training: bool = True) -> Any:
        layers = self.of_actor.training if training else self.of_actor.running
        return squashed(*gaussian(actor, layers(actor["body"], obs)), noise)

    def follow(self) -> None:
        for layer in self.of_critics:
            layer.remember(self.momentum)

    def explore(self, batch: Batch, key: Any) -> None:
        self.of_actor.remember(self.momentum)


def test_crossq_normalises_both_pairs_together_and_has_no_target_networks():
    kwargs = {"renorm_warmup_steps": 1, "batch_norm_momentum": Joint.momentum}
    config, state = begun("crossq_jax", kwargs, policy_delay=1)
    assert config.joint_pass and state.target == {}
    expected = Joint(state)

    state = check(config, state, expected)

    for i, layer in enumerate(expected.of_critics):
        found = member(state.critic.weights["statistics"]["body"], i)
        for name, held in layer.statistics.items():
            assert_same(found[name], held | {"steps": float(N_UPDATES)})
    assert float(state.actor.weights["statistics"]["body"]["BatchRenorm_0"]["steps"]) == N_UPDATES


class Sale:
    """Fujimoto et al., NeurIPS 2023, section 4; LAP is equation 10 of NeurIPS 2020."""

    def __init__(self, config, state) -> None:
        self.update_config, self.key = config, state.key
        parts = {n: plain(getattr(state, n).weights["params"]) for n in ("encoder", "actor")}
        self.encoder, self.actor = parts["encoder"], parts["actor"]
        self.critic = plain(state.critic.weights["params"])
        self.fixed = self.target_encoder = self.encoder
        self.target_actor, self.target_critic = self.actor, self.critic
        self.clip, self.range, self.n = (0.0, 0.0), [np.inf, -np.inf], 0

    def embed(self, w: Weights, obs: np.ndarray, action: np.ndarray) -> tuple[Any, Any]:
        state = average_l1(self._two(w["of_state"], obs, elu))
        return state, self._two(w["of_both"], np.concatenate([state, action], -1), elu)

    def act(self, w: Weights, obs: np.ndarray, state: np.ndarray) -> np.ndarray:
        own = average_l1(dense(w["Dense_0"], obs))
        return np.tanh(self._two(w["_Dense_0"], np.concatenate([own, state], -1), relu))

    def q_values(self, critic: Weights, obs: Any, action: Any, state: Any, both: Any) -> np.ndarray:
        values = []
        for i in range(2):
            w = member(critic, i)
            own = average_l1(dense(w["Dense_0"], np.concatenate([obs, action], -1)))
            inside = np.concatenate([own, both, state], -1)
            values.append(self._two(w["_Dense_0"], inside, elu)[:, 0])
        return np.stack(values)

    @staticmethod
    def _two(w: Weights, x: np.ndarray, activation: Any) -> np.ndarray:
        return dense(w["Dense_1"], activation(dense(w["Dense_0"], x)))

    def update(self, batch: Batch) -> tuple[dict[str, float], np.ndarray]:
        self.n += 1
        self.key, noise_key = jax.random.split(self.key)
        wanted, _ = self.embed(self.encoder, batch.next_obs, batch.action)

        def encoder_loss(w: Weights) -> float:
            return np.mean((self.embed(w, batch.obs, batch.action)[1] - wanted) ** 2)

        noise = np.clip(self.update_config.target_noise * normal(noise_key), -0.5, 0.5)
        state, _ = self.embed(self.target_encoder, batch.next_obs, batch.action)
        action = np.clip(self.act(self.target_actor, batch.next_obs, state) + noise, -1.0, 1.0)
        embedded = self.embed(self.target_encoder, batch.next_obs, action)
        value = self.q_values(self.target_critic, batch.next_obs, action, *embedded).min(0)
        alive = batch.discount * (1.0 - batch.terminated)
        y = batch.reward + alive * np.clip(value, *self.clip)
        self.range = [min(self.range[0], y.min()), max(self.range[1], y.max())]
        embedded = self.embed(self.fixed, batch.obs, batch.action)

        def errors(w: Weights) -> np.ndarray:
            return np.abs(self.q_values(w, batch.obs, batch.action, *embedded) - y)

        def critic_loss(w: Weights) -> float:
            e = errors(w)
            return np.where(e < 1.0, 0.5 * e**2, e).mean(1).sum()

        def actor_loss(w: Weights) -> float:
            action = self.act(w, batch.obs, embedded[0])
            both = self.embed(self.fixed, batch.obs, action)[1]
            return -self.q_values(self.critic, batch.obs, action, embedded[0], both).mean()

        report = {"critic_loss": critic_loss(self.critic)}
        report["encoder_loss"] = encoder_loss(self.encoder)
        priorities = np.maximum(errors(self.critic).max(0), 1.0) ** 0.4
        self.encoder = descend(encoder_loss, self.encoder, HYPER.qf_learning_rate)
        self.critic = descend(critic_loss, self.critic, HYPER.qf_learning_rate)
        if self.n % self.update_config.policy_delay == 0:
            report["actor_loss"] = actor_loss(self.actor)
            self.actor = descend(actor_loss, self.actor, HYPER.learning_rate)
        if self.n % self.update_config.target_update_interval == 0:
            self.target_actor, self.target_critic = self.actor, self.critic
            self.target_encoder, self.fixed = self.fixed, self.encoder
            self.clip = tuple(self.range)
        return report, priorities


def test_td7_learns_embeddings_clips_targets_and_copies_them_late():
    config, state = begun("td7", {"embedding_size": 5}, target_update_interval=2)
    encoder, actor, critic = (getattr(state, n).weights for n in ("encoder", "actor", "critic"))
    fixed = td7_update.Copies(encoder, actor, critic, encoder)
    state = state._replace(copies=fixed)
    expected = Sale(config, state)
    report, given = zero_metrics(td7_update.UpdateMetrics), batches(4)
    rates = HYPER.learning_rate, HYPER.qf_learning_rate

    # The third update is the first one by copied networks, within the range of targets.
    for i in range(3):
        batch = jax.tree.map(lambda x, i=i: jnp.asarray(x[i]), given)
        state, report, priorities = td7_update.update(config, state, batch, *rates, report)
        said, wanted = expected.update(jax.tree.map(np.array, batch))
        assert_same({name: report._asdict()[name] for name in said}, said)
        assert_same(priorities, wanted)

    for name in ("encoder", "actor", "critic"):
        assert_same(getattr(state, name).weights["params"], getattr(expected, name))
    assert_same(state.copies.encoder["params"], expected.fixed)
    assert_same(state.copies.target_encoder["params"], expected.target_encoder)
    assert_same(tuple(state.clip), expected.clip)
    assert tuple(state.clip) != (0.0, 0.0)
