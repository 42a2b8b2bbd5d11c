"""
What ``rl_zoo3`` 2.9 expects of the libraries with which it pushes to and loads from the Hugging
Face Hub, and newer versions of them no longer have. It concerns all algorithms.
"""

import functools
from types import ModuleType
from typing import Any


def extend_push(push_to_hub: ModuleType) -> None:
    """
    Supply ``generate_metadata``, which version 3 of ``huggingface_sb3`` made private, and which
    returned plain data.

    :param push_to_hub: the module ``huggingface_sb3.push_to_hub``
    """
    private = getattr(push_to_hub, "_generate_metadata", None)
    if private is None or hasattr(push_to_hub, "generate_metadata"):
        return

    def generate_metadata(*given: Any, **named: Any) -> dict[str, Any]:
        return private(*given, **named).to_dict()

    push_to_hub.generate_metadata = generate_metadata  # type: ignore[attr-defined]


def extend_load(load_from_hub: ModuleType) -> None:
    """
    Report a file that a repository does not have, such as statistics of ``VecNormalize``, by the
    error of ``requests`` that the zoo catches; version 1 of ``huggingface_hub`` has its own.

    :param load_from_hub: the module ``huggingface_sb3.load_from_hub``
    """
    original = load_from_hub.load_from_hub

    @functools.wraps(original)
    def load(*args: Any, **kwargs: Any) -> str:
        from huggingface_hub.errors import EntryNotFoundError, LocalEntryNotFoundError
        from requests.exceptions import HTTPError

        try:
            return original(*args, **kwargs)
        except LocalEntryNotFoundError:  # there is no connection
            raise
        except EntryNotFoundError as error:
            raise HTTPError(str(error)) from error

    load_from_hub.load_from_hub = load  # type: ignore[attr-defined]
