"""Values of command-line options: numbers, words, names."""

from collections.abc import Sequence
from typing import Any


def names(words: Sequence[str]) -> list[str]:
    """Words that blanks or commas separate."""
    return [name for word in words for name in word.split(",") if name]


def settings(option: str, texts: Sequence[str]) -> dict[str, Any]:
    """
    :param option: in whose name an error speaks
    :param texts: ``NAME:VALUE`` each
    :return: numbers, truth values and words, by name
    :raises ParameterError: for another form
    """
    from sb3_hds.errors import ParameterError

    found: dict[str, Any] = {}
    for text in texts:
        name, colon, value = text.partition(":")
        if not (name and colon and value):
            raise ParameterError(f"{option} takes NAME:VALUE, got '{text}'.")
        found[name] = _value(value)
    return found


def yml_setting(text: str) -> tuple[str, Any]:
    """
    :return: a name and its value, of ``NAME:VALUE`` with a value as in yml
    :raises ParameterError: for another form
    """
    import yaml

    from sb3_hds.errors import ParameterError

    name, colon, value = text.partition(":")
    try:
        if name and colon:
            return name, yaml.safe_load(value)
    except yaml.YAMLError:
        pass
    raise ParameterError(f"--env-kwargs takes NAME:VALUE with a value as in yml, got '{text}'.")


def _value(text: str) -> bool | int | float | str:
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
