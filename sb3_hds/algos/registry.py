"""
The registry of algorithms.

The public names of ``sb3_hds`` and ``sb3_hds.algos``, the tables of the zoo, ``load_policy``, the
tests and the documentation read this table. It imports algorithms on first use.
"""

import importlib
from collections.abc import Mapping
from typing import Any, NamedTuple


class Entry(NamedTuple):
    """
    An algorithm.

    :param name: of its class
    :param module: of its class, below ``sb3_hds.algos``
    :param policies: modules of its policies, by the names of their classes
    :param sampler: for ``rl_zoo3 train -optimize``, a key of ``rl_zoo_plugin.samplers.SAMPLERS``
    """

    name: str
    module: str
    policies: Mapping[str, str]
    sampler: str


_SAC_POLICY = "model_free.sac.policy"
_TWIN = {"TwinPolicy": "twin.policy"}
_GAUSSIAN = {"GaussianPolicy": _SAC_POLICY, "SimbaPolicy": _SAC_POLICY}

#: by id, which names the algorithm in the zoo, its yml file and its page in the documentation
ALGORITHMS: dict[str, Entry] = {
    "pods": Entry("PODS", "twin.pods", _TWIN, "planner"),
    "hds": Entry("HDS", "twin.hds.algorithm", _TWIN, "planner"),
    "gsde_sac": Entry("GSDESAC", "model_free.sac.gsde_sac", _GAUSSIAN, "gsde"),
    "droq": Entry("DroQ", "model_free.sac.droq", _GAUSSIAN, "sac"),
    "crossq_jax": Entry(
        "CrossQ", "model_free.sac.crossq", {"CrossQPolicy": "model_free.sac.crossq"}, "model_free"
    ),
    "tqc_jax": Entry("TQC", "model_free.sac.tqc", _GAUSSIAN, "tqc"),
    "simba": Entry(
        "SimbaSAC", "model_free.sac.simba", {"SimbaSACPolicy": "model_free.sac.simba"}, "blocks"
    ),
    "td7": Entry("TD7", "model_free.td7.algorithm", {"TD7Policy": "model_free.td7.policy"}, "td7"),
    "bro": Entry("BRO", "model_free.sac.bro", {"BroPolicy": "model_free.sac.bro"}, "blocks"),
    "openloop": Entry(
        "OpenLoop", "open_loop.algorithm", {"OscillatorPolicy": "open_loop.policy"}, "open_loop"
    ),
}


#: module of every policy below ``sb3_hds.algos``, by the name of its class
POLICIES = {name: home for entry in ALGORITHMS.values() for name, home in entry.policies.items()}
#: module of every algorithm and every policy
MODULES = {entry.name: entry.module for entry in ALGORITHMS.values()} | POLICIES


def load(name: str) -> Any:
    """
    :param name: of the class of an algorithm or a policy
    :return: the class
    :raises KeyError: for a name that is not in the table
    """
    return getattr(importlib.import_module(f"sb3_hds.algos.{MODULES[name]}"), name)


def registered_name(kind: Any) -> str | None:
    """:return: the name by which :func:`load` finds this class; None for a user's class"""
    home = f"sb3_hds.algos.{MODULES.get(kind.__name__)}"
    return kind.__name__ if kind.__module__ == home else None


def load_all() -> dict[str, Any]:
    """:return: every algorithm by its id"""
    return {key: load(entry.name) for key, entry in ALGORITHMS.items()}
