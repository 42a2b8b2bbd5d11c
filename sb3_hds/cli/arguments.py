"""Command-line arguments: a parser with errors of one line, and the values of options."""

import argparse
import re
from collections.abc import Sequence
from typing import Any, NoReturn

from sb3_hds.errors import ParameterError, did_you_mean

_CHOICE = re.compile(r"argument (.*): invalid choice: '?(.*?)'? \(choose from (.*)\)")
_UNKNOWN = "unrecognized arguments: "


class Parser(argparse.ArgumentParser):
    """An ``ArgumentParser`` whose errors are one line, with the nearest name that there is."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """What a command does not know is refused by the command, which knows its own options."""
        given, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"{_UNKNOWN}{' '.join(unknown)}")
        return given, unknown

    def error(self, message: str) -> NoReturn:
        """:raises SystemExit: with 2"""
        if wrong := _CHOICE.match(message):
            argument, word, listed = wrong.groups()
            choices = re.findall(r"[\w-]+", listed)
            kind = "command" if argument == "command" else argument
            known = f" There are: {', '.join(choices)}."
            message = f"there is no {kind} '{word}'.{did_you_mean(word, choices)}{known}"
        elif message.startswith(_UNKNOWN):
            words = message.removeprefix(_UNKNOWN).split()
            options = re.findall(r"--[\w-]+", self.format_help())
            wrong = next((word for word in words if word.startswith("-")), "")
            meant = did_you_mean(wrong.partition("=")[0], dict.fromkeys(options))
            message = f"unknown {'option' if wrong else 'argument'} '{wrong or words[0]}'.{meant}"
        ended = message if message.endswith((".", "?")) else f"{message}."
        self.exit(2, f"{self.prog}: {ended} See '{self.prog} --help'.\n")


class Version(argparse.Action):
    """``--version``: looked up only where it is asked for."""

    def __init__(self, option_strings: Sequence[str], dest: str) -> None:
        super().__init__(option_strings, dest, nargs=0, help="print the version, and stop")

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from importlib.metadata import PackageNotFoundError, version

        try:
            found = version("sb3-hds")
        except PackageNotFoundError:  # a checkout that is on the path without being installed
            found = "0+unknown"
        print(f"{parser.prog} {found}")
        parser.exit()


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
    found: dict[str, Any] = {}
    for text in texts:
        name, colon, value = text.partition(":")
        if not (name and colon and value):
            raise ParameterError(f"{option} takes NAME:VALUE, got '{text}'.")
        found[name] = _value(value)
    return found


def _value(text: str) -> bool | int | float | str:
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
