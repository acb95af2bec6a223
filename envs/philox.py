"""Philox 4x32-10: random numbers from counters.

Ten rounds turn a 128-bit counter under a 64-bit key into 128 random bits (Salmon, Moraes, Dror and Shaw,
"Parallel random numbers: as easy as 1, 2, 3", SC 2011); the generator passes BigCrush. NumPy has its 64-bit
sister, but for one key and one run of counters at a time; this one encrypts arrays of counters.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

MULTIPLIERS = (np.uint64(0xD2511F53), np.uint64(0xCD9E8D57))
WEYL = (0x9E3779B9, 0xBB67AE85)  # the key's increments: golden ratio and √3 − 1, in 32 bits
ROUNDS = 10
LOW_WORD = np.uint64(0xFFFFFFFF)
WORD_BITS = np.uint64(32)


def philox(key: int, counter: Sequence[NDArray[np.uint64]]) -> list[NDArray[np.uint64]]:
    """Encrypt 128-bit counters with a 64-bit key.

    Args:
        key: the 64-bit key; higher bits are dropped.
        counter: four 32-bit words, least significant first, each in the low half of a uint64 array; the four
            shapes broadcast.

    Returns:
        Four 32-bit words of random bits, in the low half of uint64 arrays.
    """
    c0, c1, c2, c3 = counter
    k0, k1 = key & 0xFFFFFFFF, (key >> 32) & 0xFFFFFFFF
    for _ in range(ROUNDS):
        p0, p1 = MULTIPLIERS[0] * c0, MULTIPLIERS[1] * c2
        c0, c1, c2, c3 = (
            (p1 >> WORD_BITS) ^ c1 ^ np.uint64(k0),
            p1 & LOW_WORD,
            (p0 >> WORD_BITS) ^ c3 ^ np.uint64(k1),
            p0 & LOW_WORD,
        )
        k0, k1 = (k0 + WEYL[0]) & 0xFFFFFFFF, (k1 + WEYL[1]) & 0xFFFFFFFF
    return [c0, c1, c2, c3]


def unit(high: NDArray[np.uint64], low: NDArray[np.uint64]) -> NDArray[np.float64]:
    """Two 32-bit words as a number of 53 bits in [0, 1)."""
    bits = (high >> np.uint64(5) << np.uint64(26)) | (low >> np.uint64(6))
    return bits.astype(np.float64) * 2.0**-53
