"""Damaged versions of a file, always the same ones."""

from collections.abc import Iterator

import numpy as np


def damaged(content: bytes, n: int) -> Iterator[bytes]:
    """:return: n versions: truncated, or with bytes changed, removed, inserted or repeated"""
    rng = np.random.default_rng(0)
    for number in range(n):
        broken = bytearray(content)
        i, j = rng.integers(len(broken), size=2)
        some = int(rng.integers(1, 200))
        match number % 6:
            case 0:
                del broken[i:]
            case 1:
                for at in rng.integers(len(broken), size=some % 8 + 1):
                    broken[at] ^= 1 << int(rng.integers(8))
            case 2:
                # Where a zip file has its directory.
                for at in rng.integers(max(0, len(broken) - 1_000), len(broken), size=3):
                    broken[at] = int(rng.integers(256))
            case 3:
                del broken[i : i + some]
            case 4:
                broken[i:i] = rng.bytes(some)
            case 5:
                broken[i : i + some] = broken[j : j + some]
        yield bytes(broken)
