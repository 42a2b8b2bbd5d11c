"""
Does one more recording settle an ambiguous verdict? The designed one compared with three others.

    python benchmarks/next_experiment.py --systems pendulum linear_axis --cases 40
    python benchmarks/next_experiment.py --report-only

The others are a chirp, a smooth random signal and a pseudo-random binary sequence (PRBS) of the
same length, within the same limits.

Cases have one planted cause, drawn as in `hidden_effects.py`, but with data that leave more open:
at twice the detection limit, with sensor errors of 5 % and six recordings at most. Only causes with
similar alternatives are planted, and only these are candidates: friction and drag; delays and lags;
gain, scale and, as always, the twin's own parameters. If the verdict is ambiguous, the engine makes
one recording from rest for each kind of command, and the explanations are weighted by it
(`Diagnosis.decided_by`). Limits are those of the case's own recordings plus a quarter, and the
rig's typical command; the three other signals are as large as the limits allow under every
explanation.

`open`: the planted cause, or an equivalent name (`same_cause.py`), is among the explanations.
`needed`: number of designed recordings that separate it from every other explanation with a
probability of 90 %, by the tool's estimate; `tellable`: a hundred at most. `settled`: after one
recording it has 95 % of the weight; `wrong`: another name has. `broken`: the largest share of a
limit that the real rig reached.

`inside`: for every diagnosed case, ambiguous or not, another recording of the rig is held out; the
share of its samples within the central 90 % of what the draws of `Diagnosis.belief` predict from
its start, with the residual errors of the best explanation added.
"""

import argparse
import dataclasses
import functools
import itertools
import json
import math
import sys
import time
import traceback
import zlib
from typing import Any

import numpy as np
import pandas as pd
from hidden_cases import (
    N_STEPS,
    RIGS,
    draw,
    from_deck,
    nominal_twin,
    plantable,
    recorded,
    sensed,
    spread,
)
from hidden_effects import key
from independent_rigs import Loop, simulate
from runs import RESULTS, save
from same_cause import equals
from scipy.special import ndtr

_TABLE = RESULTS / "next_experiment.csv"
SIGNALS = ("designed", "chirp", "random smooth", "PRBS")
# Settings with which data leave more open.
_NOISE, _RECORDINGS = "5 %", 6
_FACTOR, _FACTORS = 2.0, (2.0, 4.0, 8.0)
_FAMILIES = (
    (
        *("viscous_friction", "directional_viscous_friction", "concave_friction"),
        *("coulomb_friction", "directional_coulomb_friction", "stribeck_friction"),
        *("load_dependent_friction", "quadratic_drag"),
    ),
    ("action_delay", "motor_lag", "sensor_delay"),
    ("torque_gain", "directional_gain", "sensor_scale", "parameter"),
)
# Recordings that are held out, what numbers them apart, and the tails beyond the band.
_HELD_OUT, _SEED, _TAIL = 2, 1_000_000, 0.05
# Number of recordings beyond which the tool says that no command decides.
_MOST_RECORDINGS = 100
# Limits of a machine relative to what its recordings reach.
_ROOM = 1.25
# Share of a limit that other signals take at most, as the designed one does, and how finely their
# size is sought.
_MOST, _HALVINGS = 0.9, 7
# Weight at which a question counts as settled.
_SURE = 0.95
# Sampling intervals per level of a binary sequence.
_LEVEL = 5


class Played(Loop):
    """Given commands, without a loop."""

    def set_points(self, rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
        return np.stack([self.amplitude, self.amplitude])

    def command(self, wanted: np.ndarray, reported: np.ndarray) -> np.ndarray:
        return wanted[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").strip().splitlines()[0])
    parser.add_argument("--systems", nargs="*", default=["pendulum", "linear_axis"])
    parser.add_argument("--cases", type=int, default=40, help="of each system")
    parser.add_argument("--budget", default="quick", choices=("full", "quick"))
    parser.add_argument("--report-only", action="store_true")
    arguments = parser.parse_args()
    if not arguments.report_only:
        # Systems alternate, so that the finished cases are representative at any time.
        turns = itertools.product(range(arguments.cases), list[str](arguments.systems))
        for number, system in turns:
            deal = functools.partial(from_deck, number, system, "effect")
            large = deal("factor", _FACTORS) != _FACTOR
            lonely = not family_of(deal("effect", plantable(RIGS[system])))
            if large or lonely or (system, number) in done():
                continue
            try:
                rows = run(system, number, arguments.budget)
            except Exception:  # one case that fails must not take the others with it
                print(f"{system} {number}:\n{traceback.format_exc()}", file=sys.stderr)
                continue
            if rows:
                keep(rows)
    report()


def family_of(effect: str) -> tuple[str, ...]:
    """:return: names of effects that act similarly; empty if there are none"""
    name = effect.partition(".")[0]
    return next((family for family in _FAMILIES if name in family), ())


def done() -> set[tuple[str, int]]:
    if not _TABLE.exists():
        return set()
    table = pd.read_csv(_TABLE)
    return set(zip(table.system, table.case, strict=True))


def keep(rows: list[dict[str, Any]]) -> None:
    before = pd.read_csv(_TABLE) if _TABLE.exists() else pd.DataFrame()
    temporary = _TABLE.with_suffix(".tmp")
    pd.concat([before, pd.DataFrame(rows)]).to_csv(temporary, index=False, float_format="%.6g")
    temporary.replace(_TABLE)


def run(system: str, number: int, budget: str) -> list[dict[str, Any]]:
    """:return: a row for each signal; one row without a signal where the verdict is another"""
    from sb3_hds import Trajectories, diagnose
    from sb3_hds.effects import ALL
    from sb3_hds.sysid.design.excitation import Excitation
    from sb3_hds.sysid.design.experiment import design_problem
    from sb3_hds.sysid.design.limits import Limits

    began = time.time()
    case, data, motion = draw(system, number, kind="effect", noise=_NOISE, most=_RECORDINGS)
    twin, rig = nominal_twin(system, case.seen), RIGS[system]
    family = family_of(case.planted[0].effect)
    if not family:  # the drawn effect cannot be planted here, and another one was
        return []
    asked: dict[str, Any] = {
        "effects": [effect for effect in ALL if effect.name in family],
        "calibrate": case.nuisances,
        "seed": number,
        "budget": budget,
        "progress": False,
    }
    found = diagnose(twin, data, **asked)
    common = {"system": system, "case": number, "truth": case.truths[0], "set": first_set(found)}
    common |= {"verdict": found.verdict, "inside": inside_band(found, case)}
    common["seconds"] = time.time() - began
    if found.verdict != "ambiguous":
        print(json.dumps(common, default=str), flush=True)
        return [common | {"signal": ""}]
    limits = limits_of(system, motion)
    start = rig.seen(np.concatenate([rig.around, np.zeros(rig.dof)])[None])[0]
    seconds, rows = N_STEPS * rig.dt, []
    union, numbers, _ = design_problem(found.answers, start)
    excitation = Excitation(union, Limits.of(limits).at(union), N_STEPS, found.answers.window)
    designed = found.next_experiment(limits, seconds=seconds, start=start, progress=False)
    rng = np.random.default_rng([number, zlib.crc32(system.encode())])
    for signal in SIGNALS:
        commands = designed.commands.actions[0]
        if signal != "designed":
            commands = as_large_as_allowed(signal, excitation, numbers, rig, rng)
        obs, true = played(case, commands, rng)
        more = Trajectories.from_arrays([obs], [commands], dt=rig.dt, conditions="experiment")
        after = found.decided_by(more)
        names = [answer.name for answer in after.answers]
        values = {answer.name: values_of(answer) for answer in after.answers}
        every = np.concatenate([motion, true[:-1]])
        pressed = np.concatenate([*(data.episode(i)[1] for i in range(len(data))), commands])
        same = {case.truths[0], *equals(case, every, pressed, names, values)[case.truths[0]]}
        right = np.array([name in same for name in names])
        weight = float(after.weights[right].sum())
        rows.append(
            common
            | {
                "signal": signal,
                "set after": ";".join(
                    f"{name} {weight:.3f}"
                    for name, weight in zip(names, after.weights, strict=True)
                ),
                "open": bool(right.any()),
                "tellable": recordings_for(designed, same) <= _MOST_RECORDINGS,
                "settled": weight >= _SURE,
                "wrong": weight <= 1.0 - _SURE,
                "broken": largest_share(limits, true, rig),
                "needed": recordings_for(designed, same),
            }
        )
        print(json.dumps(rows[-1], default=str), flush=True)
    return rows


def recordings_for(designed: Any, same: set[str]) -> float:
    """:return: number of designed recordings that separate the planted cause from wrong names"""
    own = [p.needed for p in designed.pairs if p.true in same and p.other not in same]
    return max(own, default=math.inf)


def inside_band(found: Any, case: Any) -> float:
    """:return: share of samples of held-out motion in the 90 % band; nan: there is no belief"""
    if found.opened is None:
        return math.nan
    data, motion = recorded(dataclasses.replace(case, recordings=_HELD_OUT), _SEED + case.number)
    belief, noise, rig = found.belief, found.answers.noise, RIGS[case.system]
    starts = motion.reshape(_HELD_OUT, -1, motion.shape[1])[:, 0]
    seen = np.stack([rig.seen(start[None])[0] for start in starts])
    own = [predicted(belief, i, seen, data.actions) for i in range(belief.n_draws)]
    below = np.mean([ndtr((data.obs[:, 1:] - one[:, 1:]) / noise) for one in own], 0)
    return float(np.mean((below > _TAIL) & (below < 1.0 - _TAIL)))


def predicted(belief: Any, draw: int, starts: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """:return: channels under one draw, shape ``(n, steps + 1, n_obs)``"""
    import jax

    base, params = belief.base, belief.member(draw).params
    return np.asarray(_simulated(base)(params, jax.numpy.asarray(starts), actions))


@functools.lru_cache(2)
def _simulated(base: Any) -> Any:
    import jax

    from sb3_hds.core import rollout

    def one(params: Any, start: Any, actions: Any) -> Any:
        return rollout(base, params, base.infer(start, params), actions).obs

    return jax.jit(jax.vmap(one, (None, 0, 0)))


def first_set(found: Any) -> str:
    """:return: the first cause and its alternatives"""
    if not found.findings:
        return ""
    return ";".join((key(found.findings[0]), *found.findings[0].alternatives))


def values_of(answer: Any) -> dict[str, float]:
    """:return: its parameters by short name"""
    return {name.rpartition(".")[2]: answer.twin.values[name] for name in answer.factor}


def limits_of(system: str, motion: np.ndarray) -> dict[str, Any]:
    """:param motion: positions and velocities of the recordings"""
    rig, twin = RIGS[system], nominal_twin(system)
    joints, actuators = [j.name for j in twin.joints], [a.name for a in twin.actuators]
    q, v = motion[:, : rig.dof], motion[:, rig.dof :]
    middle, half = 0.5 * (q.max(0) + q.min(0)), 0.5 * np.ptp(q, 0)
    ends = np.stack([middle - _ROOM * half, middle + _ROOM * half], 1)
    largest = _ROOM * np.abs(v).max(0)
    return {
        "position": dict(zip(joints, ends.tolist(), strict=True)),
        "velocity": dict(zip(joints, largest.tolist(), strict=True)),
        "command": dict(zip(actuators, ([-t, t] for t in rig.torque), strict=True)),
    }


def largest_share(limits: dict[str, Any], true: np.ndarray, rig: Any) -> float:
    q, v = true[:, : rig.dof], true[:, rig.dof :]
    low, high = np.array(list(limits["position"].values())).T
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    speed = np.abs(v) / np.array(list(limits["velocity"].values()))
    return float(max((np.abs(q - middle) / half).max(), speed.max()))


def as_large_as_allowed(
    signal: str, excitation: Any, numbers: Any, rig: Any, rng: np.random.Generator
) -> np.ndarray:
    """:return: commands of this kind, as large as the limits allow under every explanation"""
    import jax

    shape = unit_signal(signal, len(rig.torque), rig.dt, rng) * np.array(rig.torque)
    low, high = 0.0, 1.0
    with jax.enable_x64(True):
        for _ in range(_HALVINGS):
            size = high if low == 0.0 and high == 1.0 else 0.5 * (low + high)
            usage = np.asarray(excitation.evaluate(size * shape[None], numbers).usage)
            inside = bool(np.isfinite(usage).all() and usage.max() <= _MOST)
            if inside and size == 1.0:
                return shape
            low, high = (size, high) if inside else (low, size)
    return low * shape


def unit_signal(signal: str, n: int, dt: float, rng: np.random.Generator) -> np.ndarray:
    """:return: between -1 and 1, shape ``(N_STEPS, n)``"""
    times = dt * np.arange(N_STEPS)
    if signal == "chirp":
        slow, fast, span = 1.0 / times[-1], 0.1 / dt, times[-1]
        phase = 2.0 * np.pi * (slow * times + 0.5 * (fast - slow) * times**2 / span)
        return np.sin(phase[:, None] + 0.5 * np.pi * np.arange(n))
    if signal == "random smooth":
        wander = 0.7 * rng.standard_normal((N_STEPS, n)).cumsum(0)
        return np.sin(wander + rng.uniform(0.0, 6.0, n))
    levels = rng.choice([-1.0, 1.0], (-(-N_STEPS // _LEVEL), n))
    return levels.repeat(_LEVEL, 0)[:N_STEPS]


def played(
    case: Any, commands: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """:return: what the rig's sensors report under these commands, and how it moved"""
    rig = RIGS[case.system]
    still = dataclasses.replace(rig, start=(0.0,) * rig.dof, rest=tuple(rig.around))
    nothing = np.zeros(len(rig.torque))
    obs, _ = simulate(
        still,
        list(case.planted),
        n_recordings=1,
        n_steps=N_STEPS,
        seed=int(rng.integers(2**31)),
        base_change=case.base_change,
        disturbance=case.disturbance,
        loop=Played(nothing, nothing, commands),
    )
    chance = rng.standard_normal(obs[0].shape)
    assert obs[0].shape[1] == len(spread(case.system))
    return sensed(obs[0], case.system, case.noise, chance), obs[0]


def report() -> None:
    """Print and save how often each signal settled the question, on the same cases."""
    table: Any = pd.read_csv(_TABLE)
    one_each = table.groupby(["system", "case"]).head(1)
    print(f"{len(one_each)} cases: {one_each.verdict.value_counts().to_dict()}")
    bands = [
        {
            "verdict": verdict,
            "cases": len(own),
            "inside, mean": own.inside.mean(),
            "inside, lowest decile": own.inside.quantile(0.1),
        }
        for verdict, own in (("all", one_each), *one_each.groupby("verdict"))
    ]
    print(save(bands, "next_experiment_bands").to_string(index=False))
    played = table[table.signal.isin(SIGNALS)].copy()
    flags = ["open", "tellable", "settled", "wrong"]
    played[flags] = played[flags].astype(bool)
    one = played.open & (played.needed <= 1.0)
    several = played.open & played.tellable & ~one
    classes = {
        "settled, where one designed recording should suffice": one,
        "settled, where several should": several,
        "settled, where the tool says none can": played.open & ~played.tellable,
    }
    rows = []
    for signal in SIGNALS:
        mine = played.signal == signal
        row: dict[str, Any] = {"commands": signal}
        for title, inside in classes.items():
            row[title] = f"{played[mine & inside].settled.sum()} of {(mine & inside).sum()}"
        wrong = played[mine & played.open].wrong
        row["another name settled"] = f"{wrong.sum()} of {len(wrong)}"
        row["planted cause not among the answers"] = f"{(mine & ~played.open).sum()}"
        rows.append(row | {"largest share of a limit": played[mine].broken.max()})
    print(save(rows, "next_experiment_settled").to_string(index=False))


if __name__ == "__main__":
    main()
