"""
Files of models: weights as tensors inside SB3's zip format, independent of the version of JAX.

SB3 saves every attribute that an algorithm lists in ``_get_torch_save_params`` by its
``state_dict``, and reads it back with ``torch.load(weights_only=True)``. A policy built on
:class:`TensorPolicy` implements that protocol for its pytrees; nothing of JAX or Flax is pickled.

Files are written atomically (:func:`write_whole`).
"""

import contextlib
import io
import json
import os
import pickle
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch as th

from sb3_hds.core.trajectories.storage import writing


def write_whole(
    path: str | os.PathLike[str] | io.BufferedIOBase,
    suffix: str,
    write: Callable[[io.BufferedIOBase], None],
) -> None:
    """
    Write atomically, as :func:`~sb3_hds.core.trajectories.storage.writing` does.

    :param path: of the file, whose folders are made; an open file is written to directly
    :param suffix: without a dot, appended to a name that has none, as SB3 does
    :param write: is called with the open file
    :raises OSError: if the file cannot be written; an older file is then unchanged
    """
    if not isinstance(path, str | os.PathLike):
        write(path)
        return
    target = Path(path)
    target = target if target.suffix else target.with_name(f"{target.name}.{suffix}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with writing(target, durable=True) as file:
            write(file)
    except OSError as error:
        reason = (
            f"'{target}' could not be written: {error.strerror or error}. An older file there is "
            "unchanged. The folder must be writable, with space left on the disk"
        )
        raise OSError(error.errno, reason) from error


def refuse_damaged(path: str | os.PathLike[str] | io.BufferedIOBase, *parts: str) -> None:
    """
    Read a whole zip file, so that damage is reported before anything is loaded.

    A truncated file may still look like a zip file, because the weights in it are zip files, too.

    :param path: path of a file, or an open file; ``.zip`` may be left out
    :param parts: names of entries that it must contain
    :raises OSError: if it does not exist, or cannot be opened
    :raises ValueError: if it is damaged, or is no zip file
    """
    with _opened(path) as file:
        begin = file.tell()
        try:
            with zipfile.ZipFile(file) as archive:
                # For a damaged header, zipfile raises many types of errors.
                broken, missing = archive.testzip(), set(parts) - set(archive.namelist())
        except Exception as error:
            raise damaged(path, error) from error
        file.seek(begin)
    if broken or missing:
        raise damaged(path, f"'{broken}' was changed" if broken else f"no '{min(missing)}'")


def damaged(path: Any, reason: Any) -> ValueError:
    """
    :param path: path of a file, or an open file
    :param reason: why it cannot be read
    :return: the error to raise, with a message of one line
    """
    kind = f"{type(reason).__name__}: " if isinstance(reason, Exception) else ""
    found = kind + " ".join(str(reason).split())
    return ValueError(
        f"{name_of(path)} is damaged, or is no saved model ({found:.120}): copy it once more "
        "from where it was saved, or load an older checkpoint."
    )


def name_of(path: Any) -> str:
    """:return: how a message names a path or an open file"""
    return f"'{path}'" if isinstance(path, str | os.PathLike) else "The file"


def existing(path: Any) -> Any:
    """:return: the path, with ``.zip`` where it does not exist without; an open file unchanged"""
    if not isinstance(path, str | os.PathLike):
        return path
    named = Path(path)
    return named if named.exists() else named.with_name(f"{named.name}.zip")


def _opened(path: Any) -> contextlib.AbstractContextManager[Any]:
    path = existing(path)
    if not (isinstance(path, Path) or hasattr(path, "seek")):
        raise TypeError(f"Expected the path of a file, or an open file, got {path!r}.")
    return path.open("rb") if isinstance(path, Path) else contextlib.nullcontext(path)


@contextlib.contextmanager
def damage_reported(path: Any) -> Iterator[None]:
    """
    :raises ValueError: for errors that SB3 raises for damaged files and files that lack a part
    """
    try:
        yield
    except KeyError as error:
        if not isinstance(error.__context__, ValueError):
            raise
        raise ValueError(
            f"{name_of(path)} does not fit this model, or is damaged: {error.__context__}"
        ) from error
    except (pickle.UnpicklingError, json.JSONDecodeError, UnicodeDecodeError, EOFError) as error:
        raise damaged(path, error) from error
    except RuntimeError as error:
        if "PytorchStreamReader" not in str(error):
            raise
        raise damaged(path, error) from error


def to_state_dict(tree: Any) -> dict[str, th.Tensor]:
    """:return: one tensor for each leaf, by its path in the pytree, in the order of the leaves"""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {_name(path): th.as_tensor(np.array(leaf)) for path, leaf in leaves}


def from_state_dict(tree: Any, tensors: dict[str, th.Tensor], strict: bool = True) -> Any:
    """
    :param tree: a pytree that gives structure, shapes and dtypes
    :param tensors: what :func:`to_state_dict` made of such a pytree
    :param strict: whether names must match exactly; otherwise missing leaves keep their value
    :return: the pytree with the tensors' values, on the devices of its leaves
    :raises RuntimeError: for missing or unexpected names, or another shape, as in torch
    """
    leaves, structure = jax.tree_util.tree_flatten_with_path(tree)
    expected = {_name(path): leaf for path, leaf in leaves}
    missing, unexpected = expected.keys() - tensors.keys(), tensors.keys() - expected.keys()
    if strict and (missing or unexpected):
        raise RuntimeError(
            f"The saved weights do not fit this network: missing {sorted(missing)}, "
            f"unexpected {sorted(unexpected)}. Was it built with other policy_kwargs?"
        )
    values = []
    for name, leaf in expected.items():
        if name in tensors and tuple(tensors[name].shape) != np.shape(leaf):
            raise RuntimeError(
                f"The saved weight '{name}' has shape {tuple(tensors[name].shape)}, this network "
                f"needs {np.shape(leaf)}. Was it built with other policy_kwargs?"
            )
        value = tensors[name].cpu().numpy() if name in tensors else leaf
        values.append(_where(leaf, value))
    return jax.tree_util.tree_unflatten(structure, values)


def _where(leaf: Any, value: Any) -> Any:
    """:return: the value with the leaf's dtype, on the leaf's device"""
    if isinstance(leaf, np.ndarray):
        return value
    if isinstance(leaf, jax.Array) and leaf.committed:
        return jax.device_put(np.asarray(value, leaf.dtype), leaf.sharding)
    return jnp.asarray(value, dtype=leaf.dtype)


def _name(path: tuple) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")
