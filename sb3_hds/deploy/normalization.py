"""``VecNormalize`` as a part of a policy."""

import os
from typing import Any, NamedTuple

import numpy as np

from sb3_hds.errors import ExportError

#: name of an observation that is no dictionary
WHOLE = ""


class Normalization(NamedTuple):
    """
    What ``VecNormalize`` does to one observation: ``clip((obs - mean) / scale)``.

    :param mean: of the shape of the observation
    :param scale: likewise
    :param clip: largest absolute value that comes out
    """

    mean: np.ndarray
    scale: np.ndarray
    clip: float


def normalizations(normalize: Any) -> dict[str, Normalization]:
    """
    :param normalize: a ``VecNormalize``, or None
    :return: by the key of each observation, :data:`WHOLE` where they are no dictionary; nothing
        where observations are left alone
    """
    if normalize is None or not normalize.norm_obs:
        return {}
    found = normalize.obs_rms if isinstance(normalize.obs_rms, dict) else {WHOLE: normalize.obs_rms}
    return {
        name: Normalization(
            np.asarray(part.mean, np.float64),
            np.sqrt(np.asarray(part.var, np.float64) + normalize.epsilon),
            float(normalize.clip_obs),
        )
        for name, part in found.items()
    }


def load_vec_normalize(path: str | os.PathLike[str]) -> Any:
    """
    Unpickles: load what you have saved yourself.

    :param path: ``vecnormalize.pkl`` of a training
    :raises ExportError: for a file that holds something else
    """
    import pickle

    from stable_baselines3.common.vec_env import VecNormalize

    with open(path, "rb") as file:
        try:
            found = pickle.load(file)
        # Where pickle meets damage, it may raise anything.
        except Exception as error:
            raise ExportError(f"'{path}' cannot be unpickled: {error}.") from error
    if not isinstance(found, VecNormalize):
        raise ExportError(
            f"'{path}' holds a {type(found).__name__} instead of a VecNormalize, which RL Zoo "
            "saves as vecnormalize.pkl beside a model."
        )
    return found
