"""Command-line arguments: a parser with errors of one line, and the values of options."""

import argparse
import re
import shlex
from collections.abc import Sequence
from typing import Any, NoReturn

from sb3_hds.errors import ParameterError, did_you_mean

_CHOICE = re.compile(r"argument (.*): invalid choice: '?(.*?)'? \(choose from (.*)\)")
_UNKNOWN = "unrecognized arguments: "


class Parser(argparse.ArgumentParser):
    """An ``ArgumentParser`` whose errors are one line, with the nearest known name."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Let the subparser refuse unknown arguments, since it knows the options of its command."""
        given, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"{_UNKNOWN}{' '.join(unknown)}")
        return given, unknown

    def error(self, message: str) -> NoReturn:
        """:raises SystemExit: with 2"""
        if invalid := _CHOICE.match(message):
            argument, word, listed = invalid.groups()
            choices = re.findall(r"[\w-]+", listed)
            kind = "command" if argument == "command" else argument
            known = f" There are: {', '.join(choices)}."
            message = f"there is no {kind} '{word}'.{did_you_mean(word, choices)}{known}"
        elif message.startswith(_UNKNOWN):
            words = message.removeprefix(_UNKNOWN).split()
            options = re.findall(r"--[\w-]+", self.format_help())
            option = next((word for word in words if word.startswith("-")), "")
            hint = did_you_mean(option.partition("=")[0], dict.fromkeys(options))
            message = f"unknown {'option' if option else 'argument'} '{option or words[0]}'.{hint}"
        sentence = message if message.endswith((".", "?")) else f"{message}."
        self.exit(2, f"{self.prog}: {sentence} See '{self.prog} --help'.\n")


class Version(argparse.Action):
    """``--version``, looked up on request only."""

    def __init__(self, option_strings: Sequence[str], dest: str) -> None:
        super().__init__(option_strings, dest, nargs=0, help="print the version and exit")

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from importlib.metadata import PackageNotFoundError, version

        try:
            found = version("sb3-hds")
        except PackageNotFoundError:  # a checkout that is on the path without being installed
            found = "0+unknown"
        print(f"{parser.prog} {found}")
        parser.exit()


def names(words: Sequence[str]) -> list[str]:
    """Split words at commas."""
    return [name for word in words for name in word.split(",") if name]


def settings(option: str, texts: Sequence[str]) -> dict[str, Any]:
    """
    :param option: to name in an error message
    :param texts: ``NAME:VALUE`` each
    :return: values by name: bool, int, float or str, or a list or mapping written as in yml
    :raises ParameterError: for text of another form
    """
    found: dict[str, Any] = {}
    for text in texts:
        name, colon, value = text.partition(":")
        if not (name and colon and value):
            raise ParameterError(f"{option} takes NAME:VALUE, got '{text}'.")
        found[name] = _value(option, value)
    return found


def _value(option: str, text: str) -> Any:
    if text.startswith(("[", "{")):
        import yaml

        try:
            return yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise ParameterError(f"{option}: '{text}' is no list or mapping of yml.") from error
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def positions(words: Sequence[str]) -> dict[str, float | None]:
    """
    :param words: ``NAME`` or ``NAME:POSITION`` each, where names may contain colons
    :return: positions by name; None without one
    """
    found: dict[str, float | None] = {}
    for word in names(words):
        name, _, position = word.rpartition(":")
        try:
            found[name or word] = float(position) if name else None
        except ValueError:
            found[word] = None
    return found


def with_options(message: str, options: Sequence[str], own: Sequence[str]) -> str:
    """
    :param options: names of options
    :param own: names of values of ``--set``
    :return: the message with arguments of Python as options: ``ignore=['x']`` as ``--ignore x``,
        ``integrator='rk4'`` as ``--set integrator:rk4``
    """

    def option(found: re.Match[str]) -> str:
        name, values = found[1], re.findall(r"'([^']*)'", found[2])
        if name in own:
            return f"--set {name}:{values[0]}"
        return f"--{name} {' '.join(map(shlex.quote, values))}"

    in_python = rf"\b({'|'.join((*options, *own))})=(\[[^\]]*\]|'[^']*')"
    return re.sub(r"^lock: ", "--lock: ", re.sub(in_python, option, message))
