"""Stand-ins for algorithms, so that registering them does not import JAX."""

import inspect
from collections.abc import Iterable
from typing import Any

from rl_zoo_plugin import trials
from sb3_hds.errors import did_you_mean

#: prefix of keys that set a single entry of ``policy_kwargs``
OF_POLICY = "policy_kwargs."


class LazyAlgorithm:
    """
    Stands in ``rl_zoo3.ALGOS`` for a class of ``sb3_hds`` that is imported on first use.

    It can be called, loaded from and read like the class. It is not a class: ``issubclass`` and
    ``isinstance`` need :meth:`resolve`.

    :param class_name: the public name in ``sb3_hds``
    """

    def __init__(self, class_name: str) -> None:
        self.__name__ = class_name

    def resolve(self) -> Any:
        """:return: the class itself"""
        import sb3_hds

        return getattr(sb3_hds, self.__name__)

    def __call__(self, *args: Any, **hyperparams: Any) -> Any:
        """
        :param hyperparams: those of the algorithm, and ``policy_kwargs.net_arch`` and the like
        :raises TypeError: for a hyperparameter that the algorithm does not have
        """
        algorithm = self.resolve()
        hyperparams, of_policy = _split(hyperparams)
        if of_policy:
            hyperparams["policy_kwargs"] = {**(hyperparams.get("policy_kwargs") or {}), **of_policy}
        _refuse_unknown(algorithm, hyperparams)
        defaults = {name: each.default for name, each in parameters_of(algorithm).items()}
        return algorithm(*args, **trials.capped(hyperparams, defaults))

    def load(self, path: Any, *args: Any, **hyperparams: Any) -> Any:
        """
        SB3's ``load``, which would write any keyword into the model unchecked. The policy is loaded
        as saved: like the zoo, this drops ``policy_kwargs`` and its single entries.

        :raises TypeError: for a hyperparameter that the algorithm does not have
        """
        algorithm = self.resolve()
        loaders = (
            vars(base)["load"].__func__ for base in algorithm.__mro__ if "load" in vars(base)
        )
        known = {name for loader in loaders for name in parameters_of(loader)}
        hyperparams, _ = _split(hyperparams)
        _refuse_unknown(algorithm, hyperparams, also=known)
        return algorithm.load(path, *args, **hyperparams)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.resolve(), name)

    def __repr__(self) -> str:
        return f"<sb3_hds.{self.__name__}, imported on first use>"


def _split(hyperparams: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """:return: those of the algorithm, and those of its policy without their prefix"""
    own, of_policy = {}, {}
    for name, value in hyperparams.items():
        if name.startswith(OF_POLICY):
            of_policy[name.removeprefix(OF_POLICY)] = value
        else:
            own[name] = value
    return own, of_policy


def parameters_of(function: Any) -> dict[str, inspect.Parameter]:
    """:return: the parameters of a function, or of the constructor of a class"""
    return dict(inspect.signature(function).parameters)


def _refuse_unknown(algorithm: Any, hyperparams: dict[str, Any], also: Iterable[str] = ()) -> None:
    known = list(parameters_of(algorithm))
    unknown = sorted(set(hyperparams) - set(known) - set(also))
    if not unknown:
        return
    raise TypeError(
        f"{algorithm.__name__} has no hyperparameter '{unknown[0]}'."
        f"{did_you_mean(unknown[0], known)} "
        f"Look at the yml file, -params and --conf-file. It has: {', '.join(known)}."
    )
