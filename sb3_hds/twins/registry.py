"""The registry of twins, by name and by environment id."""

import importlib
import inspect
from collections.abc import Iterable, Mapping
from typing import Any

from sb3_hds.core import Effect, Twin, seen_through
from sb3_hds.core.belief import belief_from_spec
from sb3_hds.core.contract import check_methods
from sb3_hds.errors import NoTwinError, TwinError, did_you_mean

_TWINS: dict[str, type[Twin]] = {}
_UNLISTED: set[str] = set()
_VARIADIC = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


def register(twin: type[Twin], *, listed: bool = True) -> type[Twin]:
    """
    Register a twin under its ``name`` and its ``env_id``. Usable as a class decorator.

    :param twin: a concrete subclass of ``Twin``
    :param listed: whether :func:`names` lists it; False if it cannot be made from its name alone
    :return: the class itself
    :raises TypeError: for anything but a subclass of ``Twin``
    :raises ValueError: if another class has the name or the id already
    :raises TwinError: if a method is missing, or returns a wrong shape or dtype
    """
    if not (isinstance(twin, type) and issubclass(twin, Twin)):
        raise TypeError(
            f"twins.register takes a subclass of Twin, got {twin!r}. "
            "Register the class, not an instance."
        )
    if not isinstance(getattr(twin, "name", None), str):
        raise TwinError(f"{twin.__name__} has no name. Write it into the class: name = 'MyTwin'.")
    keys = [key for key in (twin.name, twin.env_id) if key]
    for key in keys:
        other = _TWINS.get(key, twin)
        if other.__qualname__ != twin.__qualname__:
            raise ValueError(
                f"'{key}' is already the twin {other.__qualname__}. "
                f"Choose another name for {twin!r}."
            )
    if missing := sorted(getattr(twin, "__abstractmethods__", ())):
        raise TwinError(
            f"{twin.__name__} lacks {', '.join(missing)}: implement the abstract methods of "
            f"{twin.__mro__[1].__name__}."
        )
    if _has_defaults(twin):
        check_methods(twin())
    _TWINS.update(dict.fromkeys(keys, twin))
    if not listed:
        _UNLISTED.add(twin.name)
    return twin


def _has_defaults(twin: type[Twin]) -> bool:
    """Whether it can be made without arguments; otherwise it is checked on first use."""
    arguments = inspect.signature(twin).parameters.values()
    needed = [a for a in arguments if a.default is a.empty and a.kind not in _VARIADIC]
    return hasattr(twin, "dt") and not needed


def names() -> list[str]:
    """:return: the names of all twins, sorted"""
    return sorted({twin.name for twin in _TWINS.values()} - _UNLISTED)


def all_ids() -> list[str]:
    """:return: the ids of all environments that have a twin, sorted"""
    return sorted({twin.env_id for twin in _TWINS.values() if twin.env_id is not None})


def get(name_or_env_id: str) -> type[Twin]:
    """
    :param name_or_env_id: also ``"module:Name"``, as in ``gymnasium.make``: imports the module
        first, which registers the twin
    :return: the class registered under a name or an environment id
    :raises NoTwinError: if there is none; the message lists all and explains how to add one
    """
    name = str(name_or_env_id)
    module, colon, inner = name.rpartition(":")
    if colon:
        return _imported(module, inner)
    if name not in _TWINS:
        raise NoTwinError(_how_to_add_one(name))
    return _TWINS[name]


def make(name_or_env_id: str, **settings: Any) -> Twin:
    """
    :param name_or_env_id: ``"Pendulum"``, ``"Pendulum-v1"``, or ``"module:MyTwin"``, which imports
        the module that registers it
    :param settings: values of parameters, options of the twin, ``dt`` [s], ``substeps``
    :raises NoTwinError: if there is no such twin
    :raises ParameterError: for an unknown setting, or a value out of bounds
    :raises TwinError: if a method returns a wrong shape or dtype
    """
    twin = get(name_or_env_id)(**settings)
    check_methods(twin)
    return twin


def from_env(env: Any) -> Twin:
    """
    :param env: an environment made by ``gymnasium.make``, wrapped or not
    :return: its twin, with the parameters of the environment; if it simulates a twin, that one
    :raises NoTwinError: if its id has no twin
    :raises TwinError: if a method returns a wrong shape or dtype
    """
    own = getattr(env.unwrapped, "twin", None)
    if isinstance(own, Twin):
        return own
    spec = getattr(env, "spec", None)
    env_id = spec.id if spec is not None else type(env.unwrapped).__name__
    twin = get(env_id).from_env(env)
    check_methods(twin)
    return twin


def from_spec(spec: Mapping[str, Any], effects: Iterable[type[Effect]] = ()) -> Twin:
    """
    The inverse of ``Twin.to_spec``.

    :param spec: plain data
    :param effects: the classes that the names of effects stand for
    :raises NoTwinError: for an unknown twin or effect
    """
    twin = make(spec["twin"], **spec["options"], **spec["parameters"])
    known = {effect.name: effect for effect in effects}
    missing = {part["effect"] for part in spec.get("effects", ())} - set(known)
    if missing:
        raise NoTwinError(
            f"The twin '{spec['twin']}' was saved with unknown effects: {', '.join(missing)}."
        )
    attached = [
        known[part["effect"]](part["where"], **part.get("options", {}), **part["parameters"])
        for part in spec.get("effects", ())
    ]
    twin = twin.extend(*attached) if attached else twin
    twin = belief_from_spec(twin, spec["belief"]) if "belief" in spec else twin
    return seen_through(twin, spec.get("transforms", ()))


def _imported(module: str, name: str) -> type[Twin]:
    """Import a module and return the twin that it registers under a name."""
    wanted = f"{module}:{name}"
    if not (name and all(part.isidentifier() for part in module.split("."))):
        raise NoTwinError(f"Name a twin of your own as module:Name, got '{wanted}'.")
    try:
        importlib.import_module(module)
    except ImportError as error:
        raise NoTwinError(
            f"There is no twin for '{wanted}': the module cannot be imported ({error}). Install "
            "it, or add its folder to PYTHONPATH."
        ) from error
    if name in _TWINS:
        return _TWINS[name]
    theirs = [key for key, twin in _TWINS.items() if twin.__module__ == module]
    raise NoTwinError(
        f"There is no twin for '{wanted}': module '{module}' registers "
        f"{', '.join(sorted(theirs)) or 'no twin'}, not '{name}'. Use the 'name' or 'env_id' of a "
        "class that is decorated with @twins.register."
    )


def _how_to_add_one(wanted: str) -> str:
    return (
        f"There is no twin for '{wanted}'.{did_you_mean(wanted, _TWINS)}\n"
        f"Environments with a twin: {', '.join(all_ids())}.\n"
        f"Twins by name: {', '.join(names())}.\n"
        "To add your own (see 'Your own twin' in the documentation):\n\n"
        "    from sb3_hds import twins\n"
        "    from sb3_hds.core import AnalyticTwin\n\n"
        "    @twins.register\n"
        "    class MyTwin(AnalyticTwin):\n"
        f'        name, env_id, dt = "MyTwin", "{wanted}", 0.05\n'
        "        ...  # joints, actuators, channels, parameters; initial, infer, observe,\n"
        "        ...  # actuate, mass_matrix, bias, reward"
    )
