"""
The value of a belief to a policy, compared with single explanations and domain randomisation.

    python benchmarks/uncertain_verdicts.py --seeds 5
    python benchmarks/uncertain_verdicts.py --report-only

There are four situations on two machines, in which the data leave open what is wrong. The pendulum
is simulated by MuJoCo's engine (`sb3_hds/PendulumReal-v1`): a weak drive that could as well be a
heavier rod, and drag that gentle motion cannot distinguish from other friction. The cart-pole is a
twin with an effect that the twin under diagnosis lacks: commands that are late by 20 ms +- 20 ms,
known from a data sheet and from no recording, and drag on the pole where only drives and dry
friction were suspected, so that a residual remains without a name. Each seed makes its own
recordings, or draws its own delay, and diagnoses them.

HDS is trained without a real step in the nominal twin; in the twin of each explanation that the
diagnosis leaves open; in uniform boxes of 20 % and 50 % around the parameters of the nominal twin
and the gain of the drive; in the belief; and in the true twin. All policies act from the same 20
start states. `real`: mean return on the machine; `decile`: its lowest decile over start states;
`worst`: the lowest mean return over the real machine and those that the explanations describe. The
first name is the most likely explanation, the worst member the one whose policy has the lowest
`worst`.

Each run is a process of its own. Finished runs are kept, and an interrupted one resumes at its
current policy.
"""

import argparse
import json
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from hidden_cases import write
from intervals import of_mean
from runs import CACHE, RESULTS, arguments_of, fresh_process, resume, save, seconds_since_start

EPISODES, EPOCHS = 20, 60
# Of answers that are trained in, the likeliest, and of draws.
MOST, DRAWS = 3, 64
BOXES = {"box of 20 %": 0.2, "box of 50 %": 0.5}
# Start states are numbered from here.
_FIRST_START = 70_000
_DELAY = 0.02  # [s], of the cart-pole, give or take as much


class Situation(NamedTuple):
    """
    :param env: id of the task
    :param hidden: what is hidden in the machine: settings of the engine's pendulum, or effects
    :param suspects: names of the candidate effects of the diagnosis
    :param torque: of the recordings, as a share of the drive's limit
    :param gentle: whether recordings begin at rest, hanging
    """

    env: str
    hidden: dict[str, Any]
    suspects: tuple[str, ...] = ()
    torque: float = 0.8
    gentle: bool = False


PENDULUM, CART_POLE = "sb3_hds/PendulumReal-v1", "sb3_hds/CartPoleSwingUp-v0"
SITUATIONS = {
    "gain or mass": Situation(
        PENDULUM, {"gain": 0.7}, ("TorqueGain", "ViscousFriction", "CoulombFriction")
    ),
    "drag or friction": Situation(
        PENDULUM,
        {"drag": 0.1},
        ("ViscousFriction", "CoulombFriction", "QuadraticDrag"),
        torque=0.2,
        gentle=True,
    ),
    "delay +- 20 ms": Situation(CART_POLE, {}),
    "without a name": Situation(
        CART_POLE, {"drag": 0.01}, ("TorqueGain", "ActionDelay", "CoulombFriction"), torque=0.5
    ),
}
POLICIES = ("nominal", "first name", "worst member", *BOXES, "belief", "truth")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").strip().splitlines()[0])
    parser.add_argument("--situations", nargs="*", default=list(SITUATIONS), choices=SITUATIONS)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--report-only", action="store_true")
    arguments = arguments_of(parser, worker)
    if not arguments.report_only:
        wanted = [(s, seed) for seed in range(arguments.seeds) for s in arguments.situations]
        work = partial(fresh_process, __file__, cache=CACHE / "programs")
        resume("uncertain_verdicts", ("situation", "seed"), wanted, work, arguments.jobs)
    report()


def worker(name: str, seed: int) -> list[dict[str, Any]]:
    """:return: a row for each policy"""
    from sb3_hds import effects, twins

    path = CACHE / "uncertain_verdicts" / f"{name.replace(' ', '_')}_{seed}.json"
    situation = SITUATIONS[name]
    nominal = twins.make(situation.env)
    true = truth(situation, nominal, seed)
    kept = json.loads(path.read_text()) if path.exists() else None
    if kept is None:
        kept = diagnosed(situation, nominal, true, seed) | {"rows": []}
        write(path, json.dumps(kept))
    back = lambda spec: twins.from_spec(spec, effects.ALL)  # noqa: E731
    members = [back(spec) for spec in kept["members"]]
    trained = {"nominal": nominal, "belief": back(kept["belief"]), "truth": true}
    trained |= {box: boxed(nominal, share, seed) for box, share in BOXES.items()}
    trained |= {f"answer {i}": member for i, member in enumerate(members)}
    done = {row["policy"] for row in kept["rows"]}
    for policy, twin in trained.items():
        if policy in done:
            continue
        model = policy_of(twin, seed)
        real = returns_on_machine(model, situation, true)
        others = [returns_in(model, member).mean() for member in members]
        kept["rows"].append(
            {
                "policy": policy,
                "verdict": kept["verdict"],
                "answers": kept["answers"],
                "real": float(real.mean()),
                "decile": float(np.quantile(real, 0.1)),
                "worst": float(min(real.mean(), *others)),
                "seconds": seconds_since_start(),
            }
        )
        write(path, json.dumps(kept))
    return kept["rows"]


def diagnosed(situation: Situation, nominal: Any, true: Any, seed: int) -> dict[str, Any]:
    """:return: the explanations that the recordings leave open, as plain data"""
    from sb3_hds.sysid.belief.belief import belief_of

    verdict, answers = left_open(situation, nominal, true, seed)
    weights = zip(answers.answers, answers.weights, strict=True)
    return {
        "verdict": verdict,
        "answers": ";".join(f"{answer.name} {weight:.3f}" for answer, weight in weights),
        "members": [answer.twin.to_spec() for answer in answers.answers[:MOST]],
        "belief": belief_of(answers, DRAWS, seed).to_spec(),
    }


def truth(situation: Situation, nominal: Any, seed: int) -> Any:
    """:return: the true twin of the machine"""
    import gymnasium

    from sb3_hds import effects
    from sb3_hds.envs import true_twin

    if situation.env == PENDULUM:
        return true_twin(gymnasium.make(situation.env, **situation.hidden))
    if situation.hidden:
        return nominal.extend(effects.QuadraticDrag("hinge", c=situation.hidden["drag"]))
    late = _DELAY * (1.0 + np.random.default_rng(seed).uniform(-1.0, 1.0))
    return nominal.extend(effects.ActionDelay("force", delay=late))


def left_open(situation: Situation, nominal: Any, true: Any, seed: int) -> tuple[str, Any]:
    """:return: the verdict on recordings of the machine, and the remaining explanations"""
    from sb3_hds import Trajectories, diagnose, effects
    from sb3_hds.sysid.belief.answers import Answer, Answers

    if not situation.suspects:
        # A data sheet, no data: one answer, whose standard deviation is what the sheet says.
        late = nominal.extend(effects.ActionDelay("force", delay=_DELAY))
        row = {"action_delay.force.delay": np.array([_DELAY])}
        answer = Answer(("action_delay.force",), late, row)
        low, high = (
            late.with_parameters(**{"action_delay.force.delay": at}) for at in (0.0, 2.0 * _DELAY)
        )
        ends = [Answer(("action_delay.force",), one, {}, -1.0) for one in (low, high)]
        n_obs = len(nominal.channels)
        return "data sheet", Answers((answer, *ends), np.ones(n_obs), 1.0, 20, np.zeros(n_obs))
    data = Trajectories.from_arrays(*recorded(situation, true, seed), dt=nominal.dt)
    suspects = [getattr(effects, suspect) for suspect in situation.suspects]
    found = diagnose(nominal, data, effects=suspects, seed=seed, budget="quick", progress=False)
    return found.verdict, found.answers


def recorded(situation: Situation, true: Any, seed: int) -> tuple[list[Any], list[Any]]:
    """:return: observations and commands of eight recordings of five seconds"""
    rng, obs, actions = np.random.default_rng(seed), [], []
    machine = machine_of(situation, true, noise=0.02)
    (high,) = machine.action_space.high
    n_steps = round(5.0 / true.dt)
    for recording in range(8):
        options = {"state": (np.pi, 0.0)} if situation.gentle else None
        seen = [machine.reset(seed=100 * seed + recording, options=options)[0]]
        wander = 0.7 * rng.standard_normal(n_steps).cumsum() * np.sqrt(true.dt / 0.05)
        commands = (situation.torque * high * np.sin(wander + rng.uniform(0.0, 6.0)))[:, None]
        seen += [machine.step(command)[0] for command in commands]
        obs.append(np.array(seen))
        actions.append(commands)
    if situation.env != PENDULUM:
        obs = [one + 0.02 * rng.standard_normal(one.shape) for one in obs]
    return obs, actions


def machine_of(situation: Situation, true: Any, noise: float = 0.0) -> Any:
    import gymnasium

    from sb3_hds.envs import TwinEnv

    if situation.env == PENDULUM:
        return gymnasium.make(situation.env, noise=noise, **situation.hidden)
    return gymnasium.wrappers.TimeLimit(TwinEnv(true), true.max_episode_steps)


def boxed(nominal: Any, share: float, seed: int) -> Any:
    """:return: draws of all nonzero parameters and of the drive's gain, uniform in a box"""
    from sb3_hds.core.belief import BeliefTwin
    from sb3_hds.effects import TorqueGain

    twin = nominal.extend(TorqueGain(0))
    values = np.array(list(twin.values.values()))
    rng = np.random.default_rng(seed)
    draws = values * (1.0 + rng.uniform(-share, share, (DRAWS, len(values))))
    draws[0] = values
    return BeliefTwin(twin, draws)


def policy_of(twin: Any, seed: int) -> Any:
    from sb3_hds import HDS
    from sb3_hds.envs import TwinVecEnv

    model = HDS("MlpPolicy", TwinVecEnv(twin), seed=seed, pretrain_epochs=EPOCHS)
    model.learn(0)
    return model


def returns_on_machine(model: Any, situation: Situation, true: Any) -> np.ndarray:
    from sb3_hds.experiments.returns import returns_of

    return returns_of(model, machine_of(situation, true), EPISODES)


def returns_in(model: Any, twin: Any) -> np.ndarray:
    """:return: of whole episodes in a twin, from the same start states each time"""
    from sb3_hds.envs import TwinVecEnv

    env = TwinVecEnv(twin, EPISODES, max_episode_steps=-1)
    env.seed(_FIRST_START)
    obs, total = env.reset(), np.zeros(EPISODES)
    for _ in range(twin.max_episode_steps):
        actions, _ = model.predict(obs, deterministic=True)
        obs, rewards, _, _ = env.step(actions)
        total += rewards
    return total


def report() -> None:
    """Print and save means over seeds with 95 % intervals, and shares of gaps."""
    table: Any = pd.read_csv(RESULTS / "uncertain_verdicts.csv")
    rows = []
    for name, own in table.groupby("situation", sort=False):
        by = {m: own.pivot(index="seed", columns="policy", values=m) for m in MEASURED}
        chosen = {m: named(frame, by["worst"]) for m, frame in by.items()}
        told = own.groupby("seed").verdict.first().value_counts()
        for policy in POLICIES:
            row = {"situation": name, "policy": policy}
            row |= {m: _with_interval(chosen[m][policy]) for m in MEASURED}
            rows.append(row | {"seeds": len(by["real"]), "verdicts": _counted(told)})
        print(f"{name}: {gaps(chosen)}")
    print(save(rows, "uncertain_verdicts_intervals").to_string(index=False))


MEASURED = ("real", "decile", "worst")


def named(frame: Any, worst: Any) -> Any:
    """:return: the frame with first name and worst member instead of numbered explanations"""
    answers = [column for column in frame if str(column).startswith("answer ")]
    lowest = worst[answers].idxmin(axis=1)
    frame = frame.copy()
    frame["first name"] = frame["answer 0"]
    frame["worst member"] = [frame.loc[seed, column] for seed, column in lowest.items()]
    return frame


def gaps(chosen: dict[str, Any]) -> str:
    """:return: share of the gap from worst member to truth that the belief closes, and more"""
    means = {m: frame.mean() for m, frame in chosen.items()}
    worst = means["worst"]
    gap = worst["truth"] - worst["worst member"]
    closed = (worst["belief"] - worst["worst member"]) / gap if gap > 0.0 else np.nan
    told = f"the belief closes {closed:.0%} of the gap ({gap:.1f})"
    told = told if gap > 0.0 else "the worst member is no worse than the truth"
    beside = ", ".join(
        f"{box}: {means['real']['belief'] - means['real'][box]:+.1f} mean, "
        f"{means['decile']['belief'] - means['decile'][box]:+.1f} lowest decile"
        for box in BOXES
    )
    return f"{told}; the belief beside {beside}"


def _with_interval(values: Any) -> str:
    middle, low, high = of_mean(list(values))
    return f"{middle:.1f}" if np.isnan(low) else f"{middle:.1f} [{low:.1f}, {high:.1f}]"


def _counted(verdicts: Any) -> str:
    return ", ".join(f"{verdict}: {n}" for verdict, n in verdicts.items())


if __name__ == "__main__":
    main()
