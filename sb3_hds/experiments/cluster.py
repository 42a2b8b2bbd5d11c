"""Work on the machines of a Ray cluster."""

import logging
import os
import socket
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, TypeVar

from sb3_hds.errors import StudyError

Given = TypeVar("Given")
Told = TypeVar("Told")

# How long a cluster may take to answer [s]: Ray itself asks for minutes.
_ANSWERS = 10.0
# Tasks that Ray is given at a time: enough for it to see what is needed, few enough that asking
# which of them have ended costs nothing.
_IN_FLIGHT = 256


class Share(NamedTuple):
    """
    What a task takes of a node.

    :param cpus: cores
    :param gpus: may be a fraction: several tasks then share one
    :param memory: [GiB]
    """

    cpus: float = 1.0
    gpus: float = 0.0
    memory: float = 2.0


def on_cluster(
    work: Callable[[Given], Told],
    given: Sequence[Given],
    address: str = "auto",
    share: Share | None = None,
    most: int | None = None,
) -> Iterator[tuple[Given, Told]]:
    """
    Each is a task of its own. Those of a node that dies are begun anew on another one.

    :param work: what a task does; nodes need the same versions of what it imports
    :param given: what each is done with
    :param address: of the cluster; ``"auto"``: the one that this machine is part of
    :param share: of a node that a task takes; default: that of ``Share()``
    :param most: tasks at a time; default: as many as the cluster has room for
    :return: what was given and what came of it, as tasks end
    :raises StudyError: where there is no Ray, no such cluster, or no node with such a share
    """
    try:
        import ray
    except ImportError as error:
        raise StudyError("There is no Ray here: pip install 'sb3_hds[cluster]'.") from error
    share, begun = share or Share(), not ray.is_initialized()
    if begun:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        try:
            _check_answers(address)
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
        except (OSError, ValueError, RuntimeError) as error:
            raise StudyError(
                f"There is no Ray cluster at '{address}' ({error}). Start one: ray start --head."
            ) from error
    try:
        _check_room(ray.nodes(), share)

        def done(one: Given) -> Told:
            return work(one)

        task: Any = ray.remote(done).options(
            num_cpus=share.cpus,
            num_gpus=share.gpus,
            memory=int(share.memory * 2**30),
            max_retries=-1,
            scheduling_strategy="SPREAD",
        )
        waiting, running = list(reversed(given)), {}
        while waiting or running:
            while waiting and len(running) < (most or _IN_FLIGHT):
                one = waiting.pop()
                running[task.remote(one)] = one
            for ended in ray.wait(list(running), num_returns=1)[0]:
                yield running.pop(ended), ray.get(ended)
    finally:
        if begun:
            ray.shutdown()


def _check_answers(address: str) -> None:
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if colon and port.isdigit():
        socket.create_connection((host, int(port)), _ANSWERS).close()


def _check_room(nodes: Sequence[dict[str, Any]], share: Share) -> None:
    wanted = {"CPU": share.cpus, "GPU": share.gpus, "memory": share.memory * 2**30}
    alive = [node["Resources"] for node in nodes if node["Alive"]]
    if any(all(has.get(what, 0.0) >= size for what, size in wanted.items()) for has in alive):
        return
    largest = {
        what: max((has.get(what, 0.0) for has in alive), default=0.0)
        for what in ("CPU", "GPU", "memory")
    }
    raise StudyError(
        f"No node has {share.cpus:g} cores, {share.gpus:g} GPUs and {share.memory:g} GiB to give: "
        f"the largest have {largest['CPU']:g} cores, {largest['GPU']:g} GPUs and "
        f"{largest['memory'] / 2**30:.1f} GiB. Ask for less, or for a cluster with more."
    )
