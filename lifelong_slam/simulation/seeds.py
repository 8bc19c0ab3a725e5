"""One independent stream of random numbers for each use, so that no use shifts another's."""

import zlib

import numpy as np


def generator(seed: int, use: str, index: int = 0) -> np.random.Generator:
    """Return the generator of a campaign's seed for one use, e.g. a sensor's noise in one sweep."""
    return np.random.default_rng(np.random.SeedSequence([seed, zlib.crc32(use.encode()), index]))
