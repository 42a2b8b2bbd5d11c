"""
Does `diagnose` find what was hidden in data, and keep quiet where nothing was?

    python benchmarks/hidden_effects.py --cases 1000          # resumable; blocks of ten cases
    python benchmarks/hidden_effects.py --figure              # tables from what has been run

Data come from `independent_rigs.py`, sensors get white noise, and the twin under diagnosis knows
the rig but not what was planted. Sizes are 2, 4 and 8 times what the null data of the same rig and
noise would have shown (`Diagnosis.detectable`); a few effects without a slope at zero have sizes of
their own. Printed first: how far twin and engine are apart after a second where nothing was
planted, in units of each channel's spread.
"""

import argparse
import functools
import json
import time

import numpy as np
import pandas as pd
from independent_rigs import COMMANDS, FORCES, OUTSIDE, SYSTEMS, Planted, simulate
from runs import CACHE, RESULTS, fresh_process, resume

DT, N_STEPS, BLOCK = 0.02, 200, 10
NOISES = {"tick": 2e-3, "1 %": 0.01, "5 %": 0.05}
#: kind of case and its share
KINDS = {
    "effect": 0.46,
    "null": 0.12,
    "null, disturbed": 0.12,
    "null, wrong base": 0.12,
    "outside": 0.15,
    "still": 0.03,
}
# Effects that are planted; of each, how it is made from the smallest size that shows.
JOINT = (
    "viscous_friction",
    "directional_viscous_friction",
    "coulomb_friction",
    "directional_coulomb_friction",
    "stribeck_friction",
    "load_dependent_friction",
    "quadratic_drag",
    "stiffness",
    "cubic_stiffness",
    "cogging",
    "constant_force",
)
SENSOR = ("sensor_bias", "sensor_scale", "sensor_delay")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--systems", nargs="*", default=list(SYSTEMS), choices=SYSTEMS)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--budget", default="full", choices=("full", "quick"))
    parser.add_argument("--figure", action="store_true", help="only print what has been run")
    parser.add_argument("--worker", nargs=3, metavar=("SYSTEM", "BLOCK", "BUDGET"))
    arguments = parser.parse_args()
    if arguments.worker:
        system, block, budget = arguments.worker
        first = int(block) * BLOCK
        rows = [run(system, case, budget) for case in range(first, first + BLOCK)]
        print(json.dumps({"rows": [row for row in rows if row]}))
        return
    if not arguments.figure:
        n_blocks = -(-arguments.cases // (BLOCK * len(arguments.systems)))
        wanted = [(system, block) for block in range(n_blocks) for system in arguments.systems]
        work = lambda system, block: fresh_process(  # noqa: E731
            __file__, system, block, arguments.budget, cache=CACHE
        )["rows"]
        resume("hidden_effects", ("system", "block"), wanted, work, arguments.jobs)
    for system in arguments.systems:
        print(f"{system}: twin and engine differ by {mismatch(system):.1e} of the spread after 1 s")
    report(pd.read_csv(RESULTS / "hidden_effects.csv"))


@functools.cache
def believed(system: str):
    from sb3_hds import twins

    name, values = SYSTEMS[system].twin
    return twins.make(name, dt=DT, observe="qv", **values)


@functools.cache
def spread(system: str) -> np.ndarray:
    obs, _ = simulate(SYSTEMS[system], [], dt=DT, n_recordings=8, n_steps=N_STEPS, seed=1)
    return np.concatenate(obs).std(0)


def mismatch(system: str) -> float:
    """Largest difference after a second, in units of each channel's spread, without effects."""
    import jax
    import jax.numpy as jnp

    from sb3_hds.core import rollout

    twin, n = believed(system), round(1.0 / DT)
    obs, actions = simulate(SYSTEMS[system], [], dt=DT, n_recordings=8, n_steps=n, seed=2)
    with jax.enable_x64(True):
        start = jax.vmap(lambda o: twin.infer(o, twin.params))(jnp.array([o[0] for o in obs]))
        states = jax.vmap(lambda s, a: rollout(twin, twin.params, s, a).states)(
            start, jnp.array(actions)
        )
        end = jax.tree.map(lambda leaf: leaf[:, -1], states)
        found = np.asarray(jax.vmap(lambda s: twin.observe(s, twin.params))(end))
    return float(np.max(np.abs(found - np.array([o[-1] for o in obs])) / spread(system)))


def recorded(system: str, planted: list[Planted], noise: str, rng, n: int, **options):
    from sb3_hds import Trajectories

    seed = int(rng.integers(2**31))
    obs, actions = simulate(
        SYSTEMS[system], planted, dt=DT, n_recordings=n, n_steps=N_STEPS, seed=seed, **options
    )
    noisy = [o + NOISES[noise] * spread(system) * rng.standard_normal(o.shape) for o in obs]
    return Trajectories.from_arrays(noisy, actions, dt=DT)


def smallest(system: str, noise: str) -> dict[str, dict[str, float]]:
    """What null data of this rig would have shown."""
    path = CACHE / "smallest" / f"{system}_{noise.replace(' ', '')}.json"
    if not path.exists():
        from sb3_hds import diagnose

        data = recorded(system, [], noise, np.random.default_rng(99), 10)
        found = diagnose(believed(system), data, budget="quick", progress=False)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(found.to_dict()["detectable"]))
    return json.loads(path.read_text())


def planted_effect(system: str, noise: str, factor: float, rng) -> Planted:
    """One effect of the catalogue, so many times as large as what would have shown."""
    rig, twin = SYSTEMS[system], believed(system)
    kind = str(rng.choice((*JOINT, *COMMANDS, *SENSOR)))
    slot = "joint" if kind in JOINT else "actuator" if kind in COMMANDS else "channel"
    places = {"joint": twin.joints, "actuator": twin.actuators, "channel": twin.channels}[slot]
    index = int(rng.integers(len(places)))
    found = smallest(system, noise).get(f"{kind}.{places[index].name}", {})
    s = {name: factor * (size or np.nan) for name, size in found.items()}
    side = float(rng.choice((-1.0, 1.0)))
    values = {
        "directional_viscous_friction": lambda: {"b_pos": 1.5 * s["b_pos"], "b_neg": 0.0},
        "directional_coulomb_friction": lambda: {"tau_pos": 1.5 * s["tau_pos"], "tau_neg": 0.0},
        "stribeck_friction": lambda: {
            "tau_c": s["tau_c"],
            "tau_s": 3.0 * s["tau_c"],
            "v_s": 0.3 * spread(system)[rig.dof + index],
        },
        "load_dependent_friction": lambda: {"tau_c": 0.3 * s["tau_c"], "mu": s["mu"]},
        "stiffness": lambda: {"k": s["k"], "q0": 0.3 * spread(system)[index]},
        "cogging": lambda: {
            "amplitude": s["amplitude"],
            "period": float(np.clip(spread(system)[index], 0.1, 1.0)),
            "phase": 0.5,
        },
        "constant_force": lambda: {"tau_0": side * s["tau_0"]},
        "torque_gain": lambda: {"gain": max(1.0 + side * s["gain"], 0.3)},
        "directional_gain": lambda: {"gain_pos": max(1.0 - s["gain_pos"], 0.3), "gain_neg": 1.0},
        "saturation": lambda: {"limit": rig.torque[index] * (1.0 - 0.08 * factor)},
        "sensor_bias": lambda: {"bias": side * s["bias"]},
        "sensor_scale": lambda: {"scale": 1.0 + side * min(s["scale"], 0.3)},
        "motor_lag": lambda: {"time_constant": min(s["time_constant"], 0.3)},
        "action_delay": lambda: {"delay": min(s["delay"], 0.15)},
        "sensor_delay": lambda: {"delay": min(s["delay"], 0.15)},
    }.get(kind, lambda: s)()
    return Planted(kind, index, values)


def planted_outside(system: str, noise: str, rng) -> Planted:
    twin = believed(system)
    kind, index = str(rng.choice(OUTSIDE)), int(rng.integers(len(twin.joints)))

    def size(effect: str, name: str) -> float:
        return 8.0 * smallest(system, noise)[f"{effect}.{twin.joints[index].name}"][name]

    wide = spread(system)[index]
    values = {
        "position_dependent_friction": lambda: {
            "tau_c": size("coulomb_friction", "tau_c"),
            "period": 2.0 * wide,
        },
        "hysteresis": lambda: {
            "slip": 0.3 * wide,
            "stiffness": size("coulomb_friction", "tau_c") / (0.3 * wide),
        },
        "thermal_drift": lambda: {"rate": -size("viscous_friction", "b")},
        "soft_impact": lambda: {"k": 4.0 * size("stiffness", "k"), "wall": 0.7 * wide},
        "cable_spring": lambda: {"k": 4.0 * size("stiffness", "k"), "slack": 0.7 * wide},
    }[kind]()
    return Planted(kind, index, values)


def run(system: str, case: int, budget: str, only_noise: str | None = None) -> dict | None:
    """One case: everything about it is drawn from its number; None if it cannot be planted."""
    from sb3_hds import diagnose

    rng = np.random.default_rng([case, list(SYSTEMS).index(system)])
    kind = str(rng.choice(list(KINDS), p=list(KINDS.values())))
    noise = only_noise or str(rng.choice(list(NOISES), p=(0.4, 0.4, 0.2)))
    factor = float(rng.choice((2.0, 4.0, 8.0)))
    n = int(rng.choice((8, 10, 14, 20)))
    base_wrong = kind == "null, wrong base" or (kind == "effect" and rng.random() < 0.3)
    disturbed = kind == "null, disturbed" or (kind == "effect" and rng.random() < 0.3)
    planted = []
    if kind == "effect":
        planted = [planted_effect(system, noise, factor, rng)]
        if any(not np.isfinite(v) for v in planted[0].values.values()):
            return None
    elif kind == "outside":
        planted = [planted_outside(system, noise, rng)]
    data = recorded(
        system,
        planted,
        noise,
        rng,
        n,
        wrong_base=float(rng.choice((0.9, 1.1))) if base_wrong else 1.0,
        disturbance=float(rng.choice((0.02, 0.05))) if disturbed else 0.0,
        excited=kind != "still",
    )
    nuisances = (SYSTEMS[system].base[0],) if base_wrong else ()
    started = time.time()
    found = diagnose(
        believed(system), data, calibrate=nuisances, seed=case, budget=budget, progress=False
    )
    seconds = time.time() - started
    twin = believed(system)
    places = {"joint": twin.joints, "actuator": twin.actuators, "channel": twin.channels}
    truth, estimate = "", {}
    if planted:
        p = planted[0]
        slot = "actuator" if p.effect in COMMANDS else "channel" if p.effect in SENSOR else "joint"
        truth = f"{p.effect}.{places[slot][p.index].name}"
    first = found.findings[0] if found.findings else None
    named = key(first) if first else ""
    if first and named == truth:
        estimate = {
            name: (e.estimate, e.low, e.high, planted[0].values.get(name))
            for name, e in first.parameters.items()
        }
    return {
        "case": case,
        "kind": kind,
        "truth": truth,
        "factor": factor,
        "noise": noise,
        "recordings": n,
        "wrong_base": base_wrong,
        "disturbed": disturbed,
        "verdict": found.verdict,
        "named": named,
        "set": ";".join((named, *first.alternatives)) if first else "",
        "more": ";".join(map(key, found.findings[1:])),
        "gain": first.gain if first else 0.0,
        "explained": found.explained,
        "unexplained": bool(found.unexplained),
        "estimate": json.dumps(estimate),
        "seconds": seconds,
    }


def key(finding) -> str:
    inside = finding.where["slot"] == "parameter"
    return finding.effect if inside else f"{finding.effect}.{finding.where['name']}"


def wilson(hits: int, n: int) -> str:
    """:return: share with its 95 % interval"""
    from scipy.stats import binomtest

    if not n:
        return "  -"
    low, high = binomtest(hits, n).proportion_ci(method="wilson")
    return f"{hits / n:.3f} [{low:.3f}, {high:.3f}] of {n}"


def report(table: pd.DataFrame) -> None:
    table = table.fillna("")
    named = table["verdict"].isin(["named", "ambiguous"])
    for kind in (k for k in KINDS if k.startswith("null")):
        rows = table[table["kind"] == kind]
        print(f"false alarms, {kind:<18} {wilson(int(named[rows.index].sum()), len(rows))}")
        unknown = (rows["verdict"] == "unknown").sum()
        print(f'  and "unknown"                {wilson(int(unknown), len(rows))}')
    rows = table[table["kind"] == "outside"]
    print(f"refused, outside                {wilson(int((~named[rows.index]).sum()), len(rows))}")
    rows = table[table["kind"] == "still"]
    refused = (rows["verdict"] == "not_identifiable").sum()
    print(f"refused, standing still         {wilson(int(refused), len(rows))}")
    effects = table[table["kind"] == "effect"]
    for disturbed in (False, True):
        rows = effects[effects["disturbed"] == disturbed]
        label = "coloured disturbance" if disturbed else "white noise"
        for factor in (2.0, 4.0, 8.0):
            some = rows[rows["factor"] == factor]
            right = [t in s.split(";") for t, s in zip(some["truth"], some["set"], strict=True)]
            first = (some["truth"] == some["named"]).sum()
            print(
                f"{label}, {factor:.0f} times: first name right {wilson(int(first), len(some))}, "
                f"in the set {wilson(sum(right), len(some))}"
            )
    spoken = effects[named[effects.index]]
    inside = [t in s.split(";") for t, s in zip(spoken["truth"], spoken["set"], strict=True)]
    sizes = [len(s.split(";")) for s in spoken["set"]]
    print(f"truth within what was named     {wilson(sum(inside), len(spoken))}")
    print(f"mean size of the set            {np.mean(sizes) if sizes else float('nan'):.2f}")
    alone = spoken[spoken["verdict"] == "named"]
    print(
        f"right among single names        "
        f"{wilson(int((alone['truth'] == alone['named']).sum()), len(alone))}"
    )
    covered, errors = [], []
    for text in effects["estimate"]:
        for value, low, high, true in json.loads(text or "{}").values():
            if true is not None and true:
                covered.append(low <= true <= high)
                errors.append(abs(value - true) / abs(true))
    print(f"90 % intervals that cover       {wilson(sum(covered), len(covered))}")
    if errors:
        print(f"median error of a parameter     {np.median(errors):.1%}")
    print(f"median seconds                  {np.median(table['seconds']):.0f}")
    wrong = spoken[[not i for i in inside]]
    if len(wrong):
        print(wrong[["system", "case", "truth", "factor", "noise", "set"]].to_string())


assert set(JOINT) - set(FORCES) == {"viscous_friction", "coulomb_friction", "stiffness"}

if __name__ == "__main__":
    main()
