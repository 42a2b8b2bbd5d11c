"""
The overhead of a Ray cluster per run: tasks that do nothing, up to ten thousand in the queue.

    python benchmarks/cluster_overhead.py [--ray ADDRESS]

For comparison, the same tasks run in a pool of threads of this process. Without an address, the
script starts a cluster of two nodes on this machine.
"""

import argparse
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext

from runs import save

from sb3_hds.experiments.cluster import Share, on_cluster

_SIZES = (100, 1_000, 10_000)


def nothing(number: int) -> int:
    return number


@contextmanager
def two_nodes() -> Iterator[str]:
    """:return: address of a cluster of this machine"""
    from ray.cluster_utils import Cluster

    node = {"num_cpus": 2, "object_store_memory": 80 * 2**20}
    cluster = Cluster(initialize_head=True, head_node_args=node)
    try:
        cluster.add_node(**node)
        cluster.wait_for_nodes()
        yield cluster.address
    finally:
        cluster.shutdown()


def rows(address: str) -> Iterator[dict[str, float]]:
    list(on_cluster(nothing, range(20), address, Share(memory=0.1)))
    for size in _SIZES:
        begun = time.perf_counter()
        ended = sum(1 for _ in on_cluster(nothing, range(size), address, Share(memory=0.1)))
        took = time.perf_counter() - begun
        begun = time.perf_counter()
        with ThreadPoolExecutor(4) as pool:
            pooled = len(list(pool.map(nothing, range(size))))
        in_threads = time.perf_counter() - begun
        assert ended == pooled == size
        yield {
            "tasks": size,
            "cluster [s]": took,
            "cluster, per task [ms]": 1e3 * took / size,
            "threads, per task [ms]": 1e3 * in_threads / size,
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--ray", metavar="ADDRESS")
    given = parser.parse_args()
    with nullcontext(given.ray) if given.ray else two_nodes() as address:
        found = save(list(rows(address)), "cluster_overhead")
    print(found.to_string(index=False, float_format="%.3g"))


if __name__ == "__main__":
    main()
