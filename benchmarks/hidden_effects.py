"""
Detection and false-alarm rates of `diagnose` on data with and without hidden effects.

    python benchmarks/hidden_effects.py --cases 1000 --jobs 2
    python benchmarks/hidden_effects.py --cases 100 --systems pendulum furuta --kinds null
    python benchmarks/hidden_effects.py --report-only         # tables and figure of finished cases

Data come from `independent_rigs.py`; sensors round to their ticks or have white noise. The twin
under diagnosis describes the rig without the planted effects. Without any, it follows the engine to
a tenth of the smallest noise: this is measured first, and nothing runs if it fails. Sizes are 2, 4
and 8 times the detection limit (`Diagnosis.detectable`) of null data with the same rig, noise,
disturbance and nuisance parameters; a few effects whose derivative vanishes at zero have sizes of
their own (`hidden_cases.py`). An equivalent name counts as right only under its declared condition
(`same_cause.py`).

A case of a kind does not depend on the number of cases. Each is saved as soon as it is finished;
several runs at once may add to one table. On every fourth case of a kind, other rules and the
planted effects fitted from their true values are evaluated as well. In addition, one case in fifty
has the Euler twin of Pendulum-v1, which differs from the engine by half a step and by no friction,
and one in a hundred each has a six-joint arm and a three-joint leg whose twins come from their
MJCFs, driven by torques, and as many by servos in closed loop.

Half of the cases with effects have two to nine at once (`several_cases.py`); of the arm and the
leg, most do. They are scored cause by cause (`several_scores.py`), and compared with other methods
on the same data (`several_rules.py`).
"""

import argparse
import fcntl
import json
import os
import subprocess
import sys
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import several_cases
import several_rules
from hidden_cases import (
    EULERS,
    NOISES,
    PARAMETER,
    RIGS,
    SHARES,
    Case,
    draw,
    kind_of,
    nominal_twin,
    spread,
)
from hidden_scores import loaded, report
from independent_rigs import FROM_FILES, SYSTEMS, Planted, simulate
from other_rules import answers_of
from runs import CACHE, RESULTS
from same_cause import equals
from several_scores import RULE as RULE_OF_SEVERAL
from several_scores import SEVERAL

from sb3_hds.experiments.cluster import Share, on_cluster, on_this_machine

# Number of cases of one system that one process runs, so that it compiles once.
BLOCK = 40
# The same on a node of a cluster, and its memory [GiB].
_ON_A_NODE, _MEMORY = 10, 4.0
_SCRIPT = str(Path(__file__).resolve())
# One additional case of the Euler twin for so many others.
_EULER = 50
# And one is of each rig whose twin comes from a model file, torques and servos apart: a diagnosis
# of six joints takes minutes.
_OF_FILES = 100
# But of several causes, so many times as many: few joints are no measure of many.
_MORE_OF_SEVERAL = 10
# Largest difference of twin and engine after a second, as a share of the sensor noise.
_LEAST_MISMATCH = 0.1
# Compiled programs take memory maps, of which Linux gives a process 65,530.
_MAPS, _MOST_MAPS = Path("/proc/self/maps"), 20_000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument("--cases", type=int, default=1000, help="of all five systems together")
    parser.add_argument("--systems", nargs="*", default=list(RIGS), choices=RIGS)
    parser.add_argument("--kinds", nargs="*", choices=(*SHARES, EULERS))
    parser.add_argument("--jobs", type=int, help="processes at a time; default: 1")
    parser.add_argument(
        "--ray", metavar="ADDRESS", help="of a Ray cluster that shares this folder, or auto"
    )
    parser.add_argument("--budget", default="full", choices=("full", "quick"))
    parser.add_argument("--report-only", "--figure", action="store_true")
    parser.add_argument("--worker", nargs=3, metavar=("SYSTEM", "BUDGET", "CASES"))
    arguments = parser.parse_args()
    if arguments.worker:
        system, budget, cases = arguments.worker
        work(system, budget, [int(case) for case in cases.split(",")])
        return
    table = name_of_table(arguments.budget)
    check_mismatch(arguments.systems)
    if not arguments.report_only:
        wanted = numbers(arguments.cases, arguments.systems, arguments.kinds)
        failed = go(table, wanted, arguments.budget, arguments.jobs, arguments.ray)
        if failed:
            print(f"{failed} cases failed; the same command tries them again.", file=sys.stderr)
    report(table)


def name_of_table(budget: str) -> str:
    return "hidden_effects" if budget == "full" else f"hidden_effects_{budget}"


def numbers(cases: int, systems: Sequence[str], only: Sequence[str] | None) -> dict[str, list[int]]:
    """:return: numbers of the cases of each system"""
    counts = {system: -(-cases // len(SYSTEMS)) if system in SYSTEMS else 0 for system in systems}
    counts |= {system: -(-cases // _EULER) for system in systems if system not in SYSTEMS}
    counts |= {system: -(-cases // _OF_FILES) for system in systems if system in FROM_FILES}
    found = {}
    for system, count in counts.items():
        more = _MORE_OF_SEVERAL if system in FROM_FILES else 1
        kinds = [(n, kind_of(system, n)[0]) for n in range(more * count)]
        kinds = [(n, kind) for n, kind in kinds if n < count or kind == SEVERAL]
        found[system] = [n for n, kind in kinds if not only or kind in only]
    return found


def go(
    table: str, wanted: dict[str, list[int]], budget: str, jobs: int | None, ray: str | None
) -> int:
    """:return: how many cases failed"""
    left = _missing(table, wanted)
    longest, size = max(map(len, left.values()), default=0), BLOCK if ray is None else _ON_A_NODE
    # Systems alternate, so that the finished cases are representative at any time.
    blocks = [
        (system, budget, cases[first : first + size])
        for first in range(0, longest, size)
        for system, cases in left.items()
        if first < len(cases)
    ]
    ended = (
        on_this_machine(in_process, blocks, jobs or 1, _MEMORY)
        if ray is None
        else on_cluster(in_process, blocks, ray, Share(2.0, 0.0, _MEMORY), jobs)
    )
    for _ in ended:
        pass
    return sum(map(len, _missing(table, wanted).values()))


def _missing(table: str, wanted: dict[str, list[int]]) -> dict[str, list[int]]:
    done = {(row["system"], row["case"]) for row in read(table)}
    return {s: [n for n in cases if (s, n) not in done] for s, cases in wanted.items()}


def line_of(row: dict[str, Any]) -> str:
    said = ";".join(name for name in (row["set"], row["more"]) if name)
    return (
        f"{time.strftime('%H:%M:%S')} {row['system']} {row['case']}, {row['kind']}: "
        f"{row['truth'] or '-'} x{row['factor']:g} ({row['noise']}, {row['recordings']}) -> "
        f"{row['verdict']} {said} ({row['seconds']:.0f} s)"
    )


def in_process(block: tuple[str, str, list[int]]) -> None:
    """Run the cases of a block in a process that adds each to the table as soon as it ends."""
    system, budget, cases = block
    surroundings = os.environ | {
        "SB3_HDS_CACHE": str(CACHE),
        "JAX_COMPILATION_CACHE_DIR": str(CACHE),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.3",
    }
    words = [sys.executable, _SCRIPT, "--worker", system, budget, ",".join(map(str, cases))]
    subprocess.run(words, env=surroundings, check=False)


def work(system: str, budget: str, cases: list[int]) -> None:
    import jax

    for number in cases:
        try:
            row = run(system, number, budget)
        except Exception:  # one case that fails must not take the others with it
            print(f"{system} {number} failed:\n{traceback.format_exc()}", file=sys.stderr)
            continue
        keep(name_of_table(budget), row)
        print(line_of(row), file=sys.stderr, flush=True)
        if _MAPS.exists() and _MAPS.read_bytes().count(b"\n") > _MOST_MAPS:
            jax.clear_caches()


def read(table: str) -> list[dict[str, Any]]:
    path = RESULTS / f"{table}.csv"
    return loaded(path).to_dict("records") if path.exists() else []


def keep(table: str, row: dict[str, Any]) -> None:
    """Add a row atomically; other runs may add theirs at the same time."""
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{table}.csv"
    CACHE.mkdir(exist_ok=True)
    with (CACHE / f"{table}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        before = loaded(path) if path.exists() else pd.DataFrame()
        temporary = path.with_suffix(".tmp")
        after = pd.concat([before, pd.DataFrame([row])])
        after = after.drop_duplicates(["system", "case"], keep="last")
        after.to_csv(temporary, index=False, float_format="%.6g")
        temporary.replace(path)


def check_mismatch(systems: Sequence[str]) -> None:
    """Print the difference of twin and engine without planted effects; exit if it is too large."""
    worst = _LEAST_MISMATCH * min(NOISES.values())
    found = {system: mismatch(system) for system in systems if system in {**SYSTEMS, **FROM_FILES}}
    for system, apart in found.items():
        print(
            f"{system}: twin and engine differ by {apart:.1e} of the spread after a second, "
            f"a tenth of the smallest noise is {worst:.1e}",
            flush=True,
        )
    if bad := [system for system, apart in found.items() if not apart < worst]:
        sys.exit(
            f"A null would be no null: the twins of {', '.join(bad)} do not follow the engine. "
            "Give them more substeps in independent_rigs.py."
        )


def mismatch(system: str) -> float:
    """Largest difference without effects after a second, in standard deviations of each channel."""
    import jax
    import jax.numpy as jnp

    from sb3_hds.core import rollout

    twin, n = nominal_twin(system), round(1.0 / RIGS[system].dt)
    obs, actions = simulate(RIGS[system], [], n_recordings=8, n_steps=n, seed=2)
    with jax.enable_x64(True):
        start = jax.vmap(lambda o: twin.infer(o, twin.params))(jnp.array([o[0] for o in obs]))
        states = jax.vmap(lambda s, a: rollout(twin, twin.params, s, a).states)(
            start, jnp.array(actions)
        )
        end = jax.tree.map(lambda leaf: leaf[:, -1], states)
        found = np.asarray(jax.vmap(lambda s: twin.observe(s, twin.params))(end))
    return float(np.max(np.abs(found - np.array([o[-1] for o in obs])) / spread(system)))


def run(
    system: str,
    number: int,
    budget: str,
    *,
    kind: str = "",
    noise: str = "",
    most: int = 20,
    rules: bool = True,
) -> dict[str, Any]:
    """
    :param kind: instead of the one whose turn it is
    :param noise: instead of the drawn one
    :param most: recordings
    :param rules: whether other rules are asked, and an oracle, where it is the case's turn
    :return: what was planted and what was said
    """
    from sb3_hds import effects
    from sb3_hds.sysid.diagnosis.pipeline import Inquiry

    if (kind or kind_of(system, number)[0]) == SEVERAL:
        case, data, motion = several_cases.draw(system, number, noise=noise, most=most)
    else:
        case, data, motion = draw(system, number, kind=kind, noise=noise, most=most)
    twin, started = nominal_twin(system, case.seen), time.time()
    inquiry = Inquiry(twin, data, effects.ALL, case.nuisances, number, budget, False)
    reason = inquiry.given.reason_to_refuse
    found = inquiry.refused(reason) if reason else inquiry.run()
    seconds = time.time() - started
    names = [key(finding) for finding in found.findings]
    first = found.findings[0] if names else None
    turned = _turned(found.convention)
    values = {key(f): {n: e.estimate for n, e in f.parameters.items()} for f in found.findings}
    commands = np.concatenate([data.episode(i)[1] for i in range(len(data))])
    said = {}
    if case.kind == SEVERAL:
        said = of_several(case, inquiry.screened, found)
    # Other conventions are recognised before anything is simulated.
    wanted = rules and case.asked and not reason and inquiry.given.convention is None
    if wanted:
        said |= (
            others_of_several(case, inquiry, data, motion, commands, budget)
            if case.kind == SEVERAL
            else others(inquiry, case)
        )
    return {
        "system": system,
        "case": number,
        "kind": case.kind,
        "truth": ";".join(case.truths) or ";".join(p.effect for p in case.planted),
        "sizes": json.dumps([dict(p.values) for p in case.planted]),
        "same": json.dumps(equals(case, motion, commands, names, values)),
        "factor": case.factor,
        "noise": case.noise,
        "recordings": case.recordings,
        "wrong_base": case.wrong_base,
        "disturbance": case.disturbance,
        "verdict": "named" if turned else found.verdict,
        "named": names[0] if names else turned,
        "set": ";".join((names[0], *first.alternatives)) if first else turned,
        "more": ";".join(names[1:]),
        "gain": first.gain if first else 0.0,
        "explained": found.explained,
        "asked": wanted,
        "at_the_end": reached(found),
        "unexplained": bool(found.unexplained),
        "moved": " ".join(getattr(inquiry, "moved", ())),
        "estimate": json.dumps(estimates(case, found)),
        "seconds": seconds,
        **said,
    }


def of_several(case: Case, screened: Any, found: Any) -> dict[str, Any]:
    """How the data were made, which causes are detectable in them, and every set that was named."""
    visible = (
        several_cases.visible(screened, case.truths) if screened else [True] * len(case.truths)
    )
    return {
        "joints": RIGS[case.system].dof,
        "causes": len(case.planted),
        "loop": case.loop,
        "seen": case.seen,
        "visible": json.dumps(visible),
        "sets": json.dumps([[key(f), *f.alternatives] for f in found.findings]),
    }


def others_of_several(
    case: Case, inquiry: Any, data: Any, motion: np.ndarray, commands: np.ndarray, budget: str
) -> dict[str, str]:
    """The answers of other methods, with the equivalent names in these data."""
    found = several_rules.asked(inquiry, nominal_twin(case.system, case.seen), data, budget)
    return {
        f"{RULE_OF_SEVERAL}{rule}": json.dumps(
            {
                "names": answer.names,
                "same": equals(case, motion, commands, answer.names, {}),
                "seconds": answer.seconds,
            }
        )
        for rule, answer in found.items()
    }


def _turned(convention: str) -> str:
    """A reversed direction is reported as a convention; the planted effect is a sign."""
    kind, _, place = convention.partition(".")
    return f"sign_flip.{place}" if kind in ("direction", "command") else ""


def others(inquiry: Any, case: Case) -> dict[str, Any]:
    """The answers of an oracle and of other rules on the same data."""
    found: dict[str, Any] = {"oracle": oracle(inquiry, case) if case.truths else np.nan}
    for rule, (name, gain) in answers_of(inquiry).items():
        found |= {f"rule: {rule}": name, f"gain: {rule}": gain}
    return found


def estimates(case: Case, found: Any) -> dict[str, tuple[float, float, float, float]]:
    """:return: for each parameter of a found cause: estimate, ends of its interval, true value"""
    said = {}
    for finding in found.findings:
        for planted, truth in zip(case.planted, case.truths, strict=False):
            if key(finding) == truth:
                for name, e in finding.parameters.items():
                    true = true_value(planted, name, case.system)
                    if true is not None and name != "flipped":
                        turns = _turns(planted, name, e.estimate, true)
                        said[f"{truth}.{name}"] = (
                            *(x - turns for x in (e.estimate, e.low, e.high)),
                            true,
                        )
    return said


def _turns(planted: Planted, name: str, estimate: float, true: float) -> float:
    """Shift a phase by whole periods towards its true value."""
    if (planted.effect, name) != ("cogging", "phase"):
        return 0.0
    period = planted.values["period"]
    return period * round((estimate - true) / period)


def true_value(planted: Planted, name: str, system: str) -> float | None:
    if name not in planted.values:
        return None
    own = nominal_twin(system).values if planted.effect.startswith(PARAMETER) else {}
    return own.get(name, 0.0) + planted.values[name]


def reached(found: Any) -> float:
    """Share by which the found causes lower held-out errors at the end of a window."""
    if not found.gain:
        return np.nan
    last = found.gain[max(found.gain)]
    return 1.0 - (last.after / last.before) ** 2


def oracle(inquiry: Any, case: Case) -> float:
    """Share by which the planted effects, fitted from their true values, lower held-out errors."""
    search, h = inquiry.search, inquiry.hypotheses
    start = search.base(h.null, h.nuisances)
    theta, free = start.point.theta.copy(), [*start.free]
    for planted, wanted in zip(case.planted, case.truths, strict=True):
        candidate = next((c for c in h.candidates if c.key == wanted), None)
        if candidate is None:
            return np.nan
        for name, i in zip(candidate.parameters, h.indices(candidate), strict=True):
            value = true_value(planted, name.rpartition(".")[2], case.system)
            theta[i] = theta[i] if value is None else value
            free.append(i)
    best = search.base(theta, free)
    before, after = (
        np.mean((x.held_out.residual[:, -1] / search.noise) ** 2) for x in (start, best)
    )
    return float(1.0 - after / before)


def key(finding: Any) -> str:
    inside = finding.where["slot"] == "parameter"
    return finding.effect if inside else f"{finding.effect}.{finding.where['name']}"


if __name__ == "__main__":
    main()
