"""Files as a broken disk or transfer leaves them."""

from collections.abc import Iterator

import numpy as np


def damaged_copies(original: bytes, seed: int, count: int = 150) -> Iterator[bytes]:
    """Copies with one to three bytes replaced; every third one is cut off before."""
    random = np.random.default_rng(seed)
    for trial in range(count):
        data = bytearray(original)
        if trial % 3 == 0:
            data = data[: random.integers(0, len(data))]
        for position in random.integers(0, max(len(data), 1), 1 + trial % 3) if data else ():
            data[position] = random.integers(0, 256)
        yield bytes(data)
