"""
Ablations of HDS: one part changed at a time, on a stand-in for worn hardware.

    python benchmarks/hds_parts.py                        # beta, parts and weaknesses, five seeds
    python benchmarks/hds_parts.py --tables parts --seeds 2 --jobs 1
    python benchmarks/hds_parts.py --figure               # redraw the figures from the tables

The cell "worn" of `hardware.py` is heavier and longer than its data sheet says and has dry friction
and air drag; the twin has no parameter for drag, and HDS suspects no such effect. Runs with the
same seed start from the same policy unless the change affects the pretraining. Returns are means
over the same 50 start states. Finished runs are kept.

beta: the share of plans made in the model with the learned force. As in the HDS project, only that
force is learned: no parameter is estimated and no effect suspected. Besides the return, the table
has measures of the numerical stability that the HDS project asked about: the number of non-finite
samples that were dropped, the norm of the policy's gradient, and the median and the maximum, over
256 start states, of the derivative of the return of 100 steps by the first action, in the learned
model.

parts: each remedy and each use of the data switched off. "wrong twin" and "ceiling", planned in the
data sheet's twin and in the true one, are the ends of the gap; the share of it that a variant
closes is printed beside its return, also for beta.

weaknesses: the four that the authors of HDS name, with the remedy off and on, without data.
"""

import argparse
from functools import partial

import numpy as np
import pandas as pd
from hardware import N_STARTS, data_sheet, length_of, make, pretrained, return_of
from runs import CACHE, RESULTS, arguments_of, fresh_process, resume
from sim_to_real import planner

CELL, EPISODES = "worn", 5
BETAS = (0.0, 0.05, 0.1, 0.3, 1.0, "auto")
# Ends of the gap, as `sim_to_real.py` calls them.
ENDS = {"wrong twin": "wrong_twin", "ceiling": "ceiling"}
PARTS = {
    "HDS, default settings": {},
    "constant exploration noise": {"exploration_decay": 1.0},
    "no annealed acceptance": {"temperature": 0.0},
    "no terminal value": {"terminal_value": False},
    "no calibration": {"calibrated": None},
    "nothing suspected": {"suspected": ()},
    "no learned force": {"beta": 0.0},
    "beta 0.05": {"beta": 0.05},
    "no data": {"refit_freq": 0},
}
PRETRAINED_WITH = ("exploration_decay", "temperature", "terminal_value")
TABLES = ("beta", "parts", "weaknesses")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--tables", nargs="*", default=list(TABLES), choices=TABLES)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--figure", action="store_true")
    arguments = arguments_of(parser, worker)
    for table in arguments.tables:
        if not arguments.figure:
            wanted = [(v, seed) for seed in range(arguments.seeds) for v in VARIANTS[table]]
            work = partial(fresh_process, __file__, table, cache=CACHE)
            resume(f"hds_{table}", ("variant", "seed"), wanted, work, arguments.jobs)
        report(table)


def worker(table: str, variant: str, seed: int) -> dict:
    return WORK[table](variant, seed)


def learned(changes: dict, seed: int) -> tuple:
    """:return: HDS after some real episodes, with the log of each of its epochs"""
    first = {name: value for name, value in changes.items() if name in PRETRAINED_WITH}
    model, reports = pretrained(CELL, seed, **first), []
    for name, value in changes.items():
        setattr(model, name, value)
    run_epoch = model.run_epoch
    model.run_epoch = lambda n: reports.append(run_epoch(n)) or reports[-1]
    model.learn(EPISODES * length_of(CELL), reset_num_timesteps=False)
    return model, reports


def beta(variant: str, seed: int) -> dict:
    share = variant if variant == "auto" else float(variant)
    model, reports = learned({"beta": share, "calibrated": None}, seed)
    norms = derivative_norms(model)
    return {
        "return": return_of(model, CELL),
        "beta": model.model_beta,
        "dropped_samples": int(sum(int(r.dropped) for r in reports)),
        "gradient_norm": float(np.mean([float(r.gradient_norm) for r in reports])),
        "derivative_median": float(np.median(norms)),
        "derivative_worst": float(np.max(norms)),
    }


def derivative_norms(model, n_steps: int = 100, n_starts: int = 256) -> np.ndarray:
    """Norms of the derivative of the return of random torques by the first one, in the model."""
    import jax
    import jax.numpy as jnp

    twin, key = model.twin, jax.random.key(0)
    params = twin.params

    def total(first, state, rest):
        def step(state, action):
            after = twin.step(state, action, params)
            return after, twin.reward(state, action, after, params)

        actions = jnp.concatenate([first[None], rest])
        return jnp.sum(jax.lax.scan(step, state, actions)[1])

    starts = jax.vmap(lambda k: twin.initial(k, params))(jax.random.split(key, n_starts))
    actions = jax.random.uniform(key, (n_starts, n_steps, 1), minval=-2.0, maxval=2.0)
    slopes = jax.jit(jax.vmap(jax.grad(total)))(actions[:, 0], starts, actions[:, 1:])
    return np.linalg.norm(np.asarray(slopes), axis=1)


def parts(variant: str, seed: int) -> dict:
    if variant in ENDS:
        return {"return": return_of(planner(ENDS[variant], CELL, seed), CELL)}
    model, _ = learned(PARTS[variant], seed)
    return {"return": return_of(model, CELL)}


def in_twin(cell: str, **changes):
    """Return on the real system of a policy planned in the data sheet's twin."""

    def work(seed: int) -> float:
        return return_of(pretrained(cell, seed, **changes), cell)

    return work


def balanced(**changes):
    """
    Steps upright of a pole on a cart. HDS counts rewards from the best one that it saw, so that all
    others are negative: dying pays if a terminated episode is worth zero on that scale.
    """

    def work(seed: int) -> float:
        import gymnasium
        from stable_baselines3.common.evaluation import evaluate_policy

        from sb3_hds import HDS

        env = gymnasium.make("InvertedPendulum-v5")
        model = HDS(env, seed=seed, pretrain_epochs=60, **changes).learn(0)
        return float(evaluate_policy(model, env, 20)[0])

    return work


def open_loop(closed: bool):
    """The policy's commands, either computed in the twin beforehand (open loop) or in feedback."""

    def work(seed: int) -> float:
        model, env = pretrained("heavy, long", seed), make("heavy, long")
        if closed:
            return return_of(model, "heavy, long")
        from sb3_hds import envs

        mirror, returns = envs.TwinEnv(data_sheet("heavy, long")), []
        for start in range(N_STARTS):
            env.reset(seed=50_000 + start)
            data = env.unwrapped.data
            obs, _ = mirror.reset(options={"state": (data.qpos.copy(), data.qvel.copy())})
            total = 0.0
            for _ in range(length_of("heavy, long")):
                action = model.predict(obs, deterministic=True)[0]
                obs = mirror.step(action)[0]
                total += float(env.step(action)[1])
            returns.append(total)
        return float(np.mean(returns))

    return work


SHORT = {"pretrain_epochs": 60}
WEAKNESSES = {
    "long rollouts, off": in_twin(
        "heavy", horizon=100, terminal_value=False, lookahead=0, n_rollouts=32, **SHORT
    ),
    "long rollouts, on": in_twin("heavy", n_rollouts=32, **SHORT),
    "contact, off": in_twin(
        "cart friction", horizon=100, terminal_value=False, lookahead=0, n_rollouts=32, **SHORT
    ),
    "contact, on": in_twin("cart friction", n_rollouts=32, **SHORT),
    "termination, off": balanced(shift_ends=False),
    "termination, on": balanced(),
    "local minima, off": in_twin(
        "heavy", n_random_plans=0, reset_share=1.0, exploration_noise=0.0, temperature=0.0
    ),
    "local minima, on": in_twin("heavy"),
    "open loop, off": open_loop(closed=False),
    "open loop, on": open_loop(closed=True),
}


def weaknesses(variant: str, seed: int) -> dict:
    return {"return": WEAKNESSES[variant](seed)}


WORK = {"beta": beta, "parts": parts, "weaknesses": weaknesses}
VARIANTS = {
    "beta": [str(share) for share in BETAS],
    "parts": [*ENDS, *PARTS],
    "weaknesses": list(WEAKNESSES),
}


def report(table: str) -> None:
    rows = in_order(table)
    columns = [name for name in rows.columns if name not in ("variant", "seed")]
    found = rows.groupby("variant", sort=False)[columns].agg(["mean", "min", "max"])
    if table != "weaknesses":
        shares = closed(rows, in_order("parts"))
        found["closed"] = found.index.map(shares)
    print(found.to_string(float_format=lambda x: f"{x:.4g}"))
    FIGURES[table](rows).savefig(RESULTS / f"hds_{table}.png", dpi=150)


def in_order(table: str) -> pd.DataFrame:
    """:return: rows of the table in the order of the variants here"""
    rows = pd.read_csv(RESULTS / f"hds_{table}.csv", dtype={"variant": str})
    place = {variant: i for i, variant in enumerate(VARIANTS[table])}
    rows = rows[rows["variant"].isin(place)]
    return (
        rows.assign(place=rows["variant"].map(place))
        .sort_values(["place", "seed"])
        .drop(columns="place")
    )


def closed(rows: pd.DataFrame, ends: pd.DataFrame) -> dict[str, float]:
    """
    :param ends: rows of which some are of the wrong twin and of the ceiling
    :return: share of the gap that each variant closes, over seeds that it and both ends have
    """
    returns = ends.pivot(index="seed", columns="variant", values="return")
    if not set(ENDS) <= set(returns):
        return {}
    wrong, best = (returns[end].dropna() for end in ENDS)
    found = {}
    for variant, group in rows.groupby("variant", sort=False):
        own = group.set_index("seed")["return"]
        seeds = own.index.intersection(wrong.index).intersection(best.index)
        found[variant] = (own - wrong)[seeds].mean() / (best - wrong)[seeds].mean()
    return found


def beta_figure(rows: pd.DataFrame):
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(9.0, 3.0), layout="constrained")
    panels = drawing.subplots(1, 3)
    shown = (
        ("return", "return after five episodes", "linear"),
        ("gradient_norm", "norm of the policy's gradient", "linear"),
        ("derivative_worst", "worst derivative of 100 steps", "log"),
    )
    variants = list(dict.fromkeys(rows["variant"]))
    for axes, (column, title, scale) in zip(panels, shown, strict=True):
        for i, (_, group) in enumerate(rows.groupby("seed")):
            values = group.set_index("variant")[column].reindex(variants)
            axes.plot(variants, values, "o-", markersize=3.0, label=f"seed {i}")
        axes.set_yscale(scale)
        axes.set_title(title, fontsize=9)
        axes.set_xlabel("share of plans in the learned model", fontsize=8)
        axes.tick_params(labelsize=8)
    named = panels[0].get_legend_handles_labels()
    drawing.legend(*named, loc="outside upper center", ncols=5, fontsize=8, frameon=False)
    return drawing


def parts_figure(rows: pd.DataFrame):
    from matplotlib.figure import Figure

    variants = list(dict.fromkeys(rows["variant"]))[::-1]
    drawing = Figure(figsize=(6.0, 0.6 + 0.28 * len(variants)), layout="constrained")
    axes = drawing.subplots()
    draw_seeds(axes, rows, variants)
    axes.set_xlabel("return on the real system")
    return drawing


def weaknesses_figure(rows: pd.DataFrame):
    """A panel for each, because they are different tasks."""
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(v.rpartition(", ")[0] for v in rows["variant"]))
    drawing = Figure(figsize=(6.0, 1.0 * len(names)), layout="constrained")
    for axes, name in zip(drawing.subplots(len(names), 1), names, strict=True):
        draw_seeds(axes, rows, [f"{name}, on", f"{name}, off"])
    axes.set_xlabel("return on the real system; for termination, steps upright")
    return drawing


def draw_seeds(axes, rows: pd.DataFrame, variants: list[str]) -> None:
    """A dot for each seed, a line at the mean."""
    for place, variant in enumerate(variants):
        returns = rows[rows["variant"] == variant]["return"]
        axes.plot(returns, [place] * len(returns), "o", color="#27496d", markersize=4.0, alpha=0.6)
        axes.plot([returns.mean()] * 2, [place - 0.3, place + 0.3], color="#d1495b")
    axes.set_yticks(range(len(variants)), variants, fontsize=8)
    axes.set_ylim(-0.6, len(variants) - 0.4)
    axes.tick_params(axis="x", labelsize=8)
    axes.grid(axis="x", color="#e4e2db")


FIGURES = {"beta": beta_figure, "parts": parts_figure, "weaknesses": weaknesses_figure}


if __name__ == "__main__":
    main()
