"""
Whether one more recording settles what was ambiguous: designed, or a chirp, a random smooth signal
or a pseudo-random binary sequence of the same length, within the same limits.

    python benchmarks/next_experiment.py --systems pendulum linear_axis --cases 8
    python benchmarks/next_experiment.py --report-only

Cases are those of `hidden_effects.py` that ended ambiguous there, with one planted cause that has a
name, in the order of their numbers. Each is diagnosed again; then one recording is made on the
engine for each kind of command, from rest, and the answers are weighed by it
(`Diagnosis.decided_by`). Limits are what the case's own recordings took, and a quarter more, and
the rig's typical command; the three other signals are made as large as the limits allow under every
answer.

`settled`: after the recording, the planted cause, or names that mean the same in these recordings
(`same_cause.py`), have 95 % of the weight; `wrong`: others have; `open`: the planted cause was
among the answers at all. `broken`: the largest share of a limit that the real
rig took.
"""

import argparse
import dataclasses
import json
import sys
import time
import traceback
import zlib
from typing import Any

import numpy as np
import pandas as pd
from hidden_cases import N_STEPS, RIGS, believed, draw, sensed, spread
from hidden_effects import key
from independent_rigs import Loop, simulate
from runs import RESULTS
from same_cause import equals

_TABLE = RESULTS / "next_experiment.csv"
SIGNALS = ("designed", "chirp", "random smooth", "PRBS")
# What a machine may do beyond what its recordings show.
_ROOM = 1.25
# Share of a limit that other signals take at most, as the designed one does, and how finely their
# size is sought.
_MOST, _HALVINGS = 0.9, 7
# Weight from which a question is settled.
_SURE = 0.95
# Sampling intervals that a level of a binary sequence lasts.
_LEVEL = 5


class Played(Loop):
    """Commands that are given: no loop at all."""

    def set_points(self, rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
        return np.stack([self.amplitude, self.amplitude])

    def command(self, wanted: np.ndarray, reported: np.ndarray) -> np.ndarray:
        return wanted[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument("--systems", nargs="*", default=["pendulum", "linear_axis"])
    parser.add_argument("--cases", type=int, default=8, help="of each system")
    parser.add_argument("--budget", default="full", choices=("full", "quick"))
    parser.add_argument("--report-only", action="store_true")
    arguments = parser.parse_args()
    if not arguments.report_only:
        for system in arguments.systems:
            for number in ambiguous(system)[: arguments.cases]:
                if (system, number) in done():
                    continue
                try:
                    rows = run(system, number, arguments.budget)
                except Exception:  # one case that fails must not take the others with it
                    print(f"{system} {number}:\n{traceback.format_exc()}", file=sys.stderr)
                    continue
                keep(rows)
    report()


def ambiguous(system: str) -> list[int]:
    """:return: numbers of cases with one planted cause that ended ambiguous"""
    table = pd.read_csv(RESULTS / "hidden_effects.csv")
    own = table[
        (table.system == system) & (table.verdict == "ambiguous") & (table.kind == "effect")
    ]
    return sorted(own.case.tolist())


def done() -> set[tuple[str, int]]:
    return (
        set(zip(*map(pd.read_csv(_TABLE).get, ("system", "case")), strict=True))
        if (_TABLE.exists())
        else set()
    )


def keep(rows: list[dict[str, Any]]) -> None:
    before = pd.read_csv(_TABLE) if _TABLE.exists() else pd.DataFrame()
    temporary = _TABLE.with_suffix(".tmp")
    pd.concat([before, pd.DataFrame(rows)]).to_csv(temporary, index=False, float_format="%.6g")
    temporary.replace(_TABLE)


def run(system: str, number: int, budget: str) -> list[dict[str, Any]]:
    """:return: a row for each signal; one row without a signal where it is not ambiguous now"""
    from sb3_hds import Trajectories, diagnose
    from sb3_hds.sysid.design.excitation import Excitation
    from sb3_hds.sysid.design.experiment import question
    from sb3_hds.sysid.design.limits import Limits

    case, data, motion = draw(system, number)
    if len(case.truths) != 1:
        return [{"system": system, "case": number, "signal": ""}]
    twin, rig = believed(system, case.seen), RIGS[system]
    asked: dict[str, Any] = {
        "calibrate": case.nuisances,
        "seed": number,
        "budget": budget,
        "progress": False,
    }
    found = diagnose(twin, data, **asked)
    common = {"system": system, "case": number, "truth": case.truths[0], "noise": case.noise}
    common["set"] = told(found)
    if found.verdict != "ambiguous":
        return [common | {"signal": "", "verdict": found.verdict}]
    limits = limits_of(rig, motion)
    start = rig.seen(np.concatenate([rig.around, np.zeros(rig.dof)])[None])[0]
    seconds, rows = N_STEPS * rig.dt, []
    union, numbers, _ = question(found.answers, start)
    excitation = Excitation(union, Limits.of(limits).at(union), N_STEPS, found.answers.window)
    began = time.time()
    designed = found.next_experiment(limits, seconds=seconds, start=start, progress=False)
    took = time.time() - began
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
        right = [name in same for name in names]
        rows.append(
            common
            | {
                "signal": signal,
                "verdict": found.verdict,
                "set after": ";".join(
                    f"{name} {weight:.3f}"
                    for name, weight in zip(names, after.weights, strict=True)
                ),
                "open": any(right),
                "settled": float(after.weights[right].sum()) >= _SURE,
                "wrong": float(after.weights[right].sum()) <= 1.0 - _SURE,
                "broken": largest_share(limits, true, rig),
                "expected": designed.chance if signal == "designed" else np.nan,
                "needed": designed.needed if signal == "designed" else np.nan,
                "decides": designed.decides if signal == "designed" else np.nan,
                "seconds": took if signal == "designed" else np.nan,
            }
        )
        print(json.dumps(rows[-1], default=str), flush=True)
    return rows


def told(found: Any) -> str:
    """:return: the first cause and what cannot be told from it"""
    if not found.findings:
        return ""
    return ";".join((key(found.findings[0]), *found.findings[0].alternatives))


def values_of(answer: Any) -> dict[str, float]:
    """:return: its parameters by short name"""
    return {name.rpartition(".")[2]: answer.twin.values[name] for name in answer.factor}


def limits_of(rig: Any, motion: np.ndarray) -> dict[str, Any]:
    """:param motion: positions and velocities that the recordings took"""
    twin = believed_names(rig)
    q, v = motion[:, : rig.dof], motion[:, rig.dof :]
    middle, half = 0.5 * (q.max(0) + q.min(0)), 0.5 * np.ptp(q, 0)
    ends = np.stack([middle - _ROOM * half, middle + _ROOM * half], 1)
    largest = _ROOM * np.abs(v).max(0)
    return {
        "position": dict(zip(twin[0], ends.tolist(), strict=True)),
        "velocity": dict(zip(twin[0], largest.tolist(), strict=True)),
        "command": dict(zip(twin[1], ([-t, t] for t in rig.torque), strict=True)),
    }


def believed_names(rig: Any) -> tuple[list[str], list[str]]:
    system = next(name for name, one in RIGS.items() if one is rig)
    twin = believed(system)
    return [j.name for j in twin.joints], [a.name for a in twin.actuators]


def largest_share(limits: dict[str, Any], true: np.ndarray, rig: Any) -> float:
    q, v = true[:, : rig.dof], true[:, rig.dof :]
    low, high = np.array(list(limits["position"].values())).T
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    speed = np.abs(v) / np.array(list(limits["velocity"].values()))
    return float(max((np.abs(q - middle) / half).max(), speed.max()))


def as_large_as_allowed(
    signal: str, excitation: Any, numbers: Any, rig: Any, rng: np.random.Generator
) -> np.ndarray:
    """:return: commands of this kind, as large as the limits allow under every answer"""
    import jax

    shape = unit_signal(signal, len(rig.torque), rig.dt, rng) * np.array(rig.torque)
    low, high = 0.0, 1.0
    with jax.enable_x64(True):
        for _ in range(_HALVINGS):
            size = high if low == 0.0 and high == 1.0 else 0.5 * (low + high)
            usage = np.asarray(excitation.told(size * shape[None], numbers).usage)
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
    """Print how often each signal settled the question, of the same cases."""
    table = pd.read_csv(_TABLE)
    table = table[table.signal.notna() & (table.signal != "")]
    print(f"{table[['system', 'case']].drop_duplicates().shape[0]} cases")
    for signal, own in table.groupby("signal"):
        print(
            f"{signal:14s} settled {own.settled.astype(bool).sum()} of {len(own)}, wrong "
            f"{own.wrong.astype(bool).sum()}, largest share of a limit {own.broken.max():.2f}"
        )


if __name__ == "__main__":
    main()
