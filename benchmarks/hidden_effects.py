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
from independent_rigs import (
    COMMANDS,
    FORCES,
    OUTSIDE,
    SYSTEMS,
    TRANSMISSIONS,
    Planted,
    simulate,
)
from other_rules import asked
from runs import CACHE, RESULTS, fresh_process, resume

DT, N_STEPS, BLOCK = 0.02, 200, 10
NOISES = {"tick": 2e-3, "1 %": 0.01, "5 %": 0.05}
#: kind of case and its share
KINDS = {
    "effect": 0.40,
    "pair": 0.06,
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
SENSOR = ("sensor_bias", "sensor_scale", "sensor_delay", "sign_flip")
PARAMETER = "parameter"


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
    apart = tuple(TRANSMISSIONS) if rig.apart else ()
    kind = str(rng.choice((*JOINT, *COMMANDS, *SENSOR, *apart, PARAMETER)))
    if kind == PARAMETER:
        name = f"parameter.{rig.base[0]}"
        size = smallest(system, noise)[name][rig.base[0]]
        return Planted(name, 0, {rig.base[0]: factor * size * float(rng.choice((-1.0, 1.0)))})
    slot = slot_of(kind)
    places = {"joint": twin.joints, "actuator": twin.actuators, "channel": twin.channels}[slot]
    index = int(rng.integers(len(places)))
    # How far a motor that is apart leads its load, or the load lags: in units of the noise.
    lead = factor * 2.0 * NOISES[noise] * spread(system)[index]
    stiffness = rig.torque[min(index, len(rig.torque) - 1)] / lead
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
        "joint_elasticity": lambda: {
            "k": stiffness,
            "d": 0.2 * np.sqrt(stiffness * 0.25 * rig.inertia),
        },
        "backlash": lambda: {"gap": lead},
        "sign_flip": lambda: {"flipped": 1.0},
    }.get(kind, lambda: s)()
    return Planted(kind, index, values)


def slot_of(effect: str) -> str:
    return "actuator" if effect in COMMANDS else "channel" if effect in SENSOR else "joint"


def name_of(planted: Planted, system: str) -> str:
    """:return: effect and place, as a diagnosis names them"""
    twin, slot = believed(system), slot_of(planted.effect)
    if planted.effect.startswith(PARAMETER):
        return planted.effect
    places = {"joint": twin.joints, "actuator": twin.actuators, "channel": twin.channels}[slot]
    return f"{planted.effect}.{places[planted.index].name}"


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


def run(
    system: str,
    case: int,
    budget: str,
    only_noise: str | None = None,
    most: int = 20,
    rules: bool = True,
) -> dict | None:
    """
    One case: everything about it is drawn from its number.

    :param only_noise: instead of one that is drawn
    :param most: recordings
    :param rules: whether other rules are asked, and an oracle
    :return: what was planted and what was said; None if it cannot be planted
    """
    from sb3_hds import effects
    from sb3_hds.sysid.inquiry import Inquiry

    rng = np.random.default_rng([case, list(SYSTEMS).index(system)])
    kind = str(rng.choice(list(KINDS), p=list(KINDS.values())))
    noise = only_noise or str(rng.choice(list(NOISES), p=(0.4, 0.4, 0.2)))
    factor = float(rng.choice((2.0, 4.0, 8.0)))
    n = min(int(rng.choice((8, 10, 14, 20))), most)
    base_wrong = kind == "null, wrong base" or (kind == "effect" and rng.random() < 0.3)
    disturbed = kind == "null, disturbed" or (kind == "effect" and rng.random() < 0.3)
    off = float(rng.choice((0.9, 1.1)))
    planted = []
    if kind in ("effect", "pair"):
        planted = [planted_effect(system, noise, factor, rng) for _ in range(1 + (kind == "pair"))]
        sizes = [value for p in planted for value in p.values.values()]
        names = {name_of(p, system) for p in planted}
        apart = [p for p in planted if p.effect in TRANSMISSIONS]
        if not np.all(np.isfinite(sizes)) or len(names) < len(planted) or len(apart) > 1:
            return None
        base_wrong &= not apart and not planted[0].effect.startswith(PARAMETER)
        for p in planted:
            if p.effect.startswith(PARAMETER):
                off = 1.0 + p.values[SYSTEMS[system].base[0]] / base_value(system)
                if apart or not 0.3 < off < 3.0:
                    return None
    elif kind == "outside":
        planted = [planted_outside(system, noise, rng)]
    wrong = base_wrong or any(p.effect.startswith(PARAMETER) for p in planted)
    data = recorded(
        system,
        planted,
        noise,
        rng,
        n,
        wrong_base=off if wrong else 1.0,
        disturbance=float(rng.choice((0.02, 0.05))) if disturbed else 0.0,
        excited=kind != "still",
    )
    nuisances = (SYSTEMS[system].base[0],) if base_wrong else ()
    started = time.time()
    inquiry = Inquiry(believed(system), data, effects.ALL, nuisances, case, budget, False)
    reason = inquiry.poor()
    found = inquiry.refused(reason) if reason else inquiry.run()
    seconds = time.time() - started
    truths = [name_of(p, system) for p in planted] if kind != "outside" else []
    first = found.findings[0] if found.findings else None
    estimate = {}
    for finding in found.findings[:1]:
        for p, truth in zip(planted, truths, strict=False):
            if key(finding) == truth:
                estimate = {
                    name: (e.estimate, e.low, e.high, true_value(p, name, system))
                    for name, e in finding.parameters.items()
                }
    more = {}
    if rules and not reason:
        more = {f"rule: {rule}": name for rule, name in asked(inquiry).items()}
    return {
        "case": case,
        "kind": kind,
        "truth": ";".join(truths) or (planted[0].effect if planted else ""),
        "factor": factor,
        "noise": noise,
        "recordings": n,
        "wrong_base": base_wrong,
        "disturbed": disturbed,
        "verdict": found.verdict,
        "named": key(first) if first else "",
        "set": ";".join((key(first), *first.alternatives)) if first else "",
        "more": ";".join(map(key, found.findings[1:])),
        "gain": first.gain if first else 0.0,
        "explained": found.explained,
        "at_the_end": reached(found),
        "oracle": oracle(inquiry, planted, system) if rules and truths and not reason else np.nan,
        "unexplained": bool(found.unexplained),
        "estimate": json.dumps(estimate),
        "seconds": seconds,
        **more,
    }


def base_value(system: str) -> float:
    return believed(system).values[SYSTEMS[system].base[0]]


def true_value(planted: Planted, name: str, system: str) -> float | None:
    added = base_value(system) if planted.effect.startswith(PARAMETER) else 0.0
    return added + planted.values[name] if name in planted.values else None


def reached(found) -> float:
    """By which share what was found lowers held-out errors at the end of a window."""
    if not found.gain:
        return np.nan
    last = found.gain[max(found.gain)]
    return 1.0 - (last.after / last.before) ** 2


def oracle(inquiry, planted: list[Planted], system: str) -> float:
    """By which share the planted effects, fitted from their truth, lower held-out errors."""
    search, h = inquiry.search, inquiry.hypotheses
    start = search.base(h.null, h.nuisances)
    theta, free = start.point.theta.copy(), [*start.free]
    for p in planted:
        wanted = name_of(p, system)
        candidate = next((c for c in h.candidates if c.key == wanted), None)
        if candidate is None:
            return np.nan
        for name, i in zip(candidate.parameters, h.indices(candidate), strict=True):
            value = true_value(p, name.rpartition(".")[2], system)
            theta[i] = theta[i] if value is None else value
            free.append(i)
    best = search.base(theta, free)
    before, after = (np.mean((x.kept.raw[:, -1] / search.noise) ** 2) for x in (start, best))
    return float(1.0 - after / before)


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


def same(named: str, truth: str) -> bool:
    """Whether two names mean the same, or are declared not to be told apart."""
    from sb3_hds.effects import ALL

    if named == truth:
        return True
    one, other = (
        name if name.startswith(PARAMETER) else name.split(".")[0] for name in (named, truth)
    )
    declared = {kind.name: kind.equivalents for kind in ALL}
    return other in declared.get(one, ()) or one in declared.get(other, ())


def hit(truths: str, names: str) -> bool:
    """Whether one of the names is one of the causes."""
    return any(
        same(name, truth) for name in names.split(";") if name for truth in truths.split(";")
    )


def share(rows: pd.DataFrame, test) -> str:
    return wilson(sum(test(row) for _, row in rows.iterrows()), len(rows))


def report(table: pd.DataFrame) -> None:
    texts = table.select_dtypes(exclude="number").columns
    table = table.assign(**{name: table[name].fillna("") for name in texts})
    spoke = table["verdict"].isin(["named", "ambiguous"])
    nulls = table["kind"].str.startswith("null")
    for kind in (k for k in KINDS if k.startswith("null")):
        rows = table[table["kind"] == kind]
        print(f"false alarms, {kind:<18} {share(rows, lambda r: spoke[r.name])}")
        print(f'  and "unknown"                {share(rows, lambda r: r["verdict"] == "unknown")}')
    rows = table[table["kind"] == "outside"]
    print(f"refused, outside                {share(rows, lambda r: not spoke[r.name])}")
    rows = table[table["kind"] == "still"]
    refused = share(rows, lambda r: r["verdict"] == "not_identifiable")
    print(f"refused, standing still         {refused}")
    effects = table[table["kind"] == "effect"]
    for label, rows in (
        ("white noise up to 1 %", effects[~effects["disturbed"] & (effects["noise"] != "5 %")]),
        ("white noise of 5 %", effects[~effects["disturbed"] & (effects["noise"] == "5 %")]),
        ("coloured disturbance", effects[effects["disturbed"]]),
    ):
        for factor in (2.0, 4.0, 8.0):
            some = rows[rows["factor"] == factor]
            print(
                f"{label}, {factor:.0f} times: right name "
                f"{share(some, lambda r: hit(r['truth'], r['named']))}, "
                f"to the letter {share(some, lambda r: r['truth'] == r['named'])}"
            )
    said = effects[spoke[effects.index]]
    alone = said[said["verdict"] == "named"]
    print(f"right among single names        {share(alone, lambda r: hit(r['truth'], r['named']))}")
    print(f"truth within what was named     {share(said, lambda r: hit(r['truth'], r['set']))}")
    sizes = [len(names.split(";")) for names in said["set"]]
    print(f"mean size of the set            {np.mean(sizes) if sizes else float('nan'):.2f}")
    pairs = table[table["kind"] == "pair"]
    every = lambda r: f"{r['set']};{r['more']}"  # noqa: E731
    both = share(pairs, lambda r: all(hit(t, every(r)) for t in r["truth"].split(";")))
    print(f"pairs: one of them is named     {share(pairs, lambda r: hit(r['truth'], every(r)))}")
    print(f"pairs: both are                 {both}")
    _report_sizes(said)
    print(f"median seconds                  {np.median(table['seconds']):.0f}")
    for rule in (name for name in table if name.startswith("rule: ")):
        asked = table[table[rule].notna()]
        alarms = share(asked[nulls[asked.index]], lambda r, rule=rule: bool(r[rule]))
        right = share(
            asked[asked["kind"] == "effect"], lambda r, rule=rule: hit(r["truth"], r[rule])
        )
        print(f"{rule:<24} alarms {alarms}, right {right}")
    wrong = said[[not hit(r["truth"], r["set"]) for _, r in said.iterrows()]]
    if len(wrong):
        print(wrong[["system", "case", "truth", "factor", "noise", "set"]].to_string())


def _report_sizes(said: pd.DataFrame) -> None:
    """Parameters of right names, and what they explain beside what the truth does."""
    covered, errors = [], []
    for text in said["estimate"]:
        for value, low, high, true in json.loads(text or "{}").values():
            if true:
                covered.append(low <= true <= high)
                errors.append(abs(value - true) / abs(true))
    print(f"90 % intervals that cover       {wilson(sum(covered), len(covered))}")
    if errors:
        print(f"median error of a parameter     {np.median(errors):.1%}")
    right = said[[hit(r["truth"], r["named"]) for _, r in said.iterrows()]]
    ratio = right["at_the_end"] / right["oracle"]
    if len(ratio):
        print(f"median gain beside the oracle's {np.nanmedian(ratio):.0%}")


assert set(JOINT) - set(FORCES) == {"viscous_friction", "coulomb_friction", "stiffness"}

if __name__ == "__main__":
    main()
