"""Run tasks on this machine, or on the machines of a Ray cluster."""

import contextlib
import logging
import os
import socket
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from sb3_hds.errors import StudyError

Input = TypeVar("Input")
Result = TypeVar("Result")

# Time limit of the connection to a cluster [s]; Ray itself retries for minutes.
_TIMEOUT = 10.0
# Tasks submitted to Ray at a time: enough for it to see the demand, few enough that polling them is
# cheap.
_IN_FLIGHT = 256


class Share(NamedTuple):
    """
    Resources of a task on its node.

    :param cpus: number of cores
    :param gpus: number of GPUs; with a fraction, tasks share one
    :param memory: [GiB]
    """

    cpus: float = 1.0
    gpus: float = 0.0
    memory: float = 2.0


def on_this_machine(
    work: Callable[[Input], Result],
    given: Sequence[Input],
    jobs: int | None = None,
    memory: float = 2.0,
) -> Iterator[tuple[Input, Result]]:
    """
    Run a function on each input, in threads: its work is that of processes that it starts.

    :param work: the function
    :param given: the inputs
    :param jobs: tasks at a time; default: one per core
    :param memory: of a task [GiB]; limits the tasks at a time to what fits into free memory
    :return: inputs and results, as tasks end
    """
    wanted, free = jobs or os.cpu_count() or 1, _free_memory()
    at_a_time = max(1, wanted if free is None else min(wanted, int(free / memory)))
    with ThreadPoolExecutor(at_a_time) as pool:
        waited = {pool.submit(work, one): one for one in given}
        for future in as_completed(waited):
            yield waited[future], future.result()


def _free_memory() -> float | None:
    """[GiB]; None if the system does not report it."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) / 2**20
    return None


def on_cluster(
    work: Callable[[Input], Result],
    given: Sequence[Input],
    address: str = "auto",
    share: Share | None = None,
    most: int | None = None,
) -> Iterator[tuple[Input, Result]]:
    """
    Run a function on each input, as tasks of a cluster. Tasks of a node that dies are restarted on
    another one.

    :param work: the function; nodes need the same versions of what it imports
    :param given: the inputs
    :param address: of the cluster; ``"auto"``: the one that this machine belongs to
    :param share: resources of a task; default: ``Share()``
    :param most: tasks at a time; default: as many as the cluster has resources for
    :return: inputs and results, as tasks end
    :raises StudyError: without Ray, for an unknown cluster, or if no node has the resources
    """
    try:
        import ray
    except ImportError as error:
        raise StudyError("Ray is not installed: pip install 'sb3_hds[cluster]'.") from error
    share, begun = share or Share(), not ray.is_initialized()
    if begun:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        try:
            _check_reachable(address)
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
        except (OSError, ValueError, RuntimeError) as error:
            raise StudyError(
                f"There is no Ray cluster at '{address}' ({error}). Start one: ray start --head."
            ) from error
    try:
        _check_resources(ray.nodes(), share)

        def done(one: Input) -> Result:
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


def _check_reachable(address: str) -> None:
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if colon and port.isdigit():
        socket.create_connection((host, int(port)), _TIMEOUT).close()


def _check_resources(nodes: Sequence[dict[str, Any]], share: Share) -> None:
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
        f"{largest['memory'] / 2**30:.1f} GiB. Request less, or use a larger cluster."
    )
