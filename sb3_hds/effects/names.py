"""Effects by name, as people write it."""

from collections.abc import Iterable

from sb3_hds.core import Effect
from sb3_hds.errors import EffectError, did_you_mean


def effect_named(name: str, kinds: Iterable[type[Effect]]) -> type[Effect]:
    """
    :param name: ``"coulomb_friction"``, ``"CoulombFriction"`` or ``"coulomb friction"``
    :param kinds: the classes among which it is looked for
    :raises EffectError: for another name, with the nearest
    """
    by_name = {kind.name: kind for kind in kinds}
    by_letters = {_letters(known): kind for known, kind in by_name.items()}
    if _letters(name) in by_letters:
        return by_letters[_letters(name)]
    meant = did_you_mean(name.lower(), by_name)
    raise EffectError(f"There is no effect '{name}'.{meant} There are: {', '.join(by_name)}.")


def _letters(name: str) -> str:
    return "".join(letter for letter in name.rpartition(".")[2].lower() if letter.isalnum())
