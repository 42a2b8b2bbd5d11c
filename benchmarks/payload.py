"""
The PODS paper's comparison on its 2D pendulum payload: second order, BPTT, first order.

    python benchmarks/payload.py [--seeds 5] [--epochs 40]

All three methods have the same networks, start states, number of rollouts, discount and number of
Adam steps per epoch, and otherwise the settings of the paper: whole episodes of 100 steps, no
terminal value, one improvement of each plan, regression with a squared error. Backpropagation
through time (BPTT) takes each Adam step along the gradient of the mean objective through the twin
and the policy, from the same start states.

The objective is minus the cost whose inverse is the paper's reward (see the twin). Return and
objective are measured on 500 start states that no epoch has used. ``worsened`` counts plans kept
although worse than what they started from.
"""

import argparse
import sys
import time

from runs import RESULTS, arguments_of, fresh_process, save

METHODS = ("first_order", "gauss_newton", "bptt")
GOALS = ("stop", "stop_at_origin")
N_ROLLOUTS, HORIZON, GRADIENT_STEPS = 256, 100, 50
MEASURED = (1, 2, 5, 10, 20, 30, 40, 60, 80, 100)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--epochs", type=int, default=40)
    parser.add_argument("--figure", action="store_true")
    arguments = arguments_of(parser, worker)
    if not arguments.figure:
        rows = []
        for goal in GOALS:
            for seed in range(arguments.seeds):
                for method in METHODS:
                    print(f"{goal}, {method}, seed {seed} ...", file=sys.stderr, flush=True)
                    result = fresh_process(__file__, method, goal, seed, arguments.epochs)
                    labels = {"goal": goal, "method": method, "seed": seed}
                    rows += [labels | point for point in result["curve"]]
                    save(rows, "payload")
    report()


def worker(method: str, goal: str, seed: int, epochs: int) -> dict:
    import jax

    from sb3_hds import PODS, twins

    twin = twins.make("PayloadPendulum", goal=goal)
    model = PODS(
        "sb3_hds/PayloadPendulum-v0",
        twin=twin,
        planner="gauss_newton" if method == "bptt" else method,
        horizon=HORIZON,
        n_rollouts=N_ROLLOUTS,
        n_iterations=1,
        n_step_sizes=14,
        n_random_plans=0,
        lookahead=0,
        terminal_value=False,
        reset_share=1.0,
        plan_memory=1,
        loss="squared",
        gain_weight=0.0,
        sensitivity_weight=0.0,
        averaging=0.0,
        adapt_scales=False,
        learned_share=1.0,
        compare_every=0,
        least_gain=0.0,
        gamma=1.0,
        batch_size=N_ROLLOUTS * 8,
        learning_rate=1e-3,
        policy_kwargs={"linear_path": False},
        seed=seed,
    )
    model.learn(0) if model.pretrain_epochs == 0 else None
    measure = make_measure(model)
    advance = backpropagation(model) if method == "bptt" else model_epoch(model)
    curve, seconds, worsened = [], 0.0, 0
    for epoch in range(1, epochs + 1):
        begin = time.perf_counter()
        worsened += advance()
        jax.block_until_ready(model.policy.networks)
        elapsed = time.perf_counter() - begin
        seconds += elapsed if epoch > 1 else 0.0
        if epoch in MEASURED or epoch == epochs:
            objective, reward = measure()
            curve.append(
                {
                    "epoch": epoch,
                    "objective": objective,
                    "return": reward,
                    "run_seconds": seconds,
                    "first_epoch_seconds": elapsed
                    if epoch == 1
                    else curve[0]["first_epoch_seconds"],
                    "worsened": worsened,
                }
            )
    return {"curve": curve}


def model_epoch(model):
    """One epoch of PODS."""
    from stable_baselines3.common.utils import configure_logger

    model.set_logger(configure_logger(0))

    def advance() -> int:
        return int(model.run_epoch(GRADIENT_STEPS).worsened)

    return advance


def backpropagation(model):
    """Adam steps along the gradient of the mean objective through policy and twin."""

    import jax

    from sb3_hds.algos.twin.policy import clipped_adam
    from sb3_hds.algos.twin.state import resets
    from sb3_hds.planning import Problem, follow

    twin, actor = model.twin, model.policy.actor_network
    problem = Problem(twin, twin.params)
    adam = clipped_adam(model.policy.max_grad_norm)
    rate = model.lr_schedule(1.0)

    @jax.jit
    def epoch(weights, state, inside, key):
        starts = resets(twin, twin.params, key, N_ROLLOUTS)

        def loss(weights):
            policy = lambda obs: actor.apply(weights, inside(obs))  # noqa: E731
            plans = jax.vmap(lambda start: follow(problem, start, policy, HORIZON))(starts)
            return -plans.value.mean() / HORIZON

        def update(carry, _):
            weights, state = carry
            change, state = adam.update(jax.grad(loss)(weights), state, weights)
            return (jax.tree.map(lambda w, c: w - rate * c, weights, change), state), None

        return jax.lax.scan(update, (weights, state), None, length=GRADIENT_STEPS)[0]

    model._epoch_state()
    keys = iter(jax.random.split(jax.random.key(model.seed), 10_000))
    state = [adam.init(model.policy.networks.actor)]

    def advance() -> int:
        nets = model.policy.networks
        weights, state[0] = epoch(nets.actor, state[0], nets.inside, next(keys))
        model.policy.networks = nets._replace(actor=weights, average=weights)
        return 0

    return advance


def make_measure(model):
    """Mean objective and mean return of the policy over 500 unseen start states."""
    import jax

    from sb3_hds.algos.twin.state import resets
    from sb3_hds.planning import Problem, follow

    twin, actor = model.twin, model.policy.actor_network
    problem = Problem(twin, twin.params)
    starts = resets(twin, twin.params, jax.random.key(99), 500)

    @jax.jit
    def both(networks):
        policy = lambda obs: actor.apply(networks.average, networks.inside(obs))  # noqa: E731
        plans = jax.vmap(lambda start: follow(problem, start, policy, HORIZON))(starts)
        before = jax.tree.map(lambda leaf: leaf[:, :-1], plans.states)
        after = jax.tree.map(lambda leaf: leaf[:, 1:], plans.states)
        reward = lambda s, u, n: twin.reward(s, problem.action(u), n, twin.params)  # noqa: E731
        rewards = jax.vmap(jax.vmap(reward))(before, plans.controls, after)
        return plans.value.mean(), rewards.sum(1).mean()

    return lambda: tuple(map(float, both(model.policy.networks)))


def report() -> None:
    import pandas as pd

    table = pd.read_csv(RESULTS / "payload.csv")
    grouped = table.groupby(["goal", "epoch", "method"])
    summary = grouped.agg(
        objective=("objective", "mean"),
        worst=("objective", "min"),
        best=("objective", "max"),
        reward=("return", "mean"),
        run_seconds=("run_seconds", "mean"),
        worsened=("worsened", "sum"),
        seeds=("seed", "count"),
    )
    print(summary.to_string(float_format="%.3f"))
    figure(table)


def figure(table) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    names = {
        "first_order": "PODS, first order",
        "gauss_newton": "PODS, second order",
        "bptt": "BPTT",
    }
    fig, axes = plt.subplots(2, 2, figsize=(10, 7), sharey="row")
    for row, goal in zip(axes, GOALS, strict=True):
        for axis, x in zip(row, ("epoch", "run_seconds"), strict=True):
            for i, method in enumerate(METHODS):
                runs = table[(table.goal == goal) & (table.method == method)]
                for j, (_, one) in enumerate(runs.groupby("seed")):
                    label = None if j else names[method]
                    axis.plot(one[x], -one.objective, color=f"C{i}", alpha=0.7, label=label)
            axis.set(title=goal.replace("_", " "), yscale="log")
            axis.set_xlabel("epoch" if x == "epoch" else "wall time without compilation [s]")
            axis.grid(alpha=0.3)
        row[0].set_ylabel("mean cost of 500 episodes")
    axes[0, 0].legend()
    fig.tight_layout()
    fig.savefig(RESULTS / "payload.png", dpi=120)


if __name__ == "__main__":
    main()
