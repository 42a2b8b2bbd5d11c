"""The registered twins, the listed effects and the environments of the package, as Markdown."""

import math
from collections.abc import Iterable, Mapping

from tables import table

from sb3_hds import effects, twins
from sb3_hds.core import Actuator, Channel, Parameter, Twin
from sb3_hds.envs.registration import HARDWARE, STEP_LIMITS, TASKS


def twins_as_markdown() -> str:
    """:return: one table of all twins, then a section for each"""
    classes = _own_twins()
    overview = table(
        ["twin", "environment", "joints", "actuators", "dt [s]", "steps of an episode"],
        [
            [
                f"[`{twin.name}`](#{twin.name.lower()})",
                f"`{twin.env_id}`" if twin.env_id else "none",
                ", ".join(joint.name for joint in twin.joints),
                ", ".join(actuator.name for actuator in twin.actuators),
                f"{twin.dt:g}",
                f"{twin.max_episode_steps or 'no limit'}",
            ]
            for twin in classes
        ],
    )
    return overview + "".join(map(_section, classes))


def surrogates_as_markdown() -> str:
    """:return: one table of what planning maximises in each twin"""
    rows = [
        [
            f"[`{twin.name}`](#{twin.name.lower()})",
            "useful" if twin.reward_has_gradient else "flat almost everywhere",
            "a surrogate, below" if has_surrogate(twin) else "the reward itself",
        ]
        for twin in _own_twins()
    ]
    return table(["twin", "gradient of the reward", "what planning maximises"], rows)


def effects_as_markdown() -> str:
    """:return: one table of all effects, then the equations of each"""
    rows = []
    for effect in effects.ALL:
        names = [f"`{name}` [{p.unit}]" for name, p in effect.parameters.items()]
        rows.append([f"`{effect.__name__}`", effect.slot, ", ".join(names), effect.explanation])
    overview = table(["effect", "acts on a", "parameters", "what it is"], rows)
    return overview + "".join(_effect_section(effect) for effect in effects.ALL)


def nameless_as_markdown() -> str:
    """:return: the equations of the forces that no diagnosis names"""
    return "".join(_effect_section(effect) for effect in effects.NAMELESS)


def environments_as_markdown() -> str:
    """:return: one table of the ids that the package registers"""
    rows = [
        [f"`{env_id}`", f"[`{name}`](twins.md#{name.lower()})", str(steps)]
        for env_id, steps in STEP_LIMITS.items()
        for name in [twins.get(env_id).name]
    ]
    rows += [
        [f"`{env_id}`", f"none: MuJoCo's engine; [its twin](twins.md#{name.lower()})", str(steps)]
        for env_id, (_, steps) in HARDWARE.items()
        for name in [twins.get(env_id).name]
    ]
    rows += [[f"`{env_id}`", "none", str(steps)] for env_id, (_, steps) in TASKS.items()]
    return table(["id", "made of the twin", "steps of an episode"], rows)


def has_surrogate(twin: type[Twin]) -> bool:
    """:return: whether planning maximises something else than the reward"""
    return twin.planning_reward is not Twin.planning_reward


def _own_twins() -> list[type[Twin]]:
    return [twins.get(name) for name in twins.names()]


def _section(twin: type[Twin]) -> str:
    parts = [
        f"## {twin.name}\n\n",
        _described(f"sb3_hds.twins.{twin.__name__}"),
        "Commands:\n\n",
        _signals(twin.actuators),
        "Observations:\n\n",
        _signals(twin().channels),
        "Parameters:\n\n",
        _parameters(twin.parameters),
    ]
    if twin.options:
        chosen = ", ".join(f"`{name}` ({value!r})" for name, value in twin.options.items())
        parts.append(f"Options, with their defaults: {chosen}.\n\n")
    if twin.native_effects:
        parts.append("Effects that add to a parameter of its own:\n\n")
        parts.append(_native_effects(twin))
    return "".join(parts)


def _effect_section(effect: type) -> str:
    parts = [
        f"## {effect.__name__}\n\n",
        _described(f"sb3_hds.effects.{effect.__name__}"),
        _parameters(effect.parameters),
    ]
    for other, condition in effect.equivalents.items():
        parts.append(f"Cannot be distinguished from `{other}` {condition}.\n\n")
    return "".join(parts)


def _described(name: str) -> str:
    return f"```{{eval-rst}}\n.. autoclass:: {name}\n   :no-index-entry:\n```\n\n"


def _signals(signals: Iterable[Actuator | Channel]) -> str:
    rows = [[f"`{s.name}`", s.unit, _limits(s.low, s.high)] for s in signals]
    return table(["name", "unit", "limits"], rows)


def _parameters(parameters: Mapping[str, Parameter]) -> str:
    rows = [
        [f"`{name}`", f"{p.null:g}", p.unit, f"{p.scale:g}", _limits(p.lower, p.upper)]
        for name, p in parameters.items()
    ]
    return table(["name", "default", "unit", "typical deviation", "bounds"], rows)


def _native_effects(twin: type[Twin]) -> str:
    rows = [
        [f"`{effect}` at `{twin.joints[place].name}`", f"`{own}` adds to `{target}`"]
        for (effect, place), targets in twin.native_effects.items()
        for own, target in targets.items()
    ]
    return table(["effect", "parameter"], rows)


def _limits(low: float, high: float) -> str:
    if math.isinf(low) and math.isinf(high):
        return "none"
    if math.isinf(high):
        return f"at least {low:g}"
    if math.isinf(low):
        return f"at most {high:g}"
    return f"{low:g} to {high:g}"
