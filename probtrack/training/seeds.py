"""Seeds that several numbers determine together."""

import numpy as np


def seed_of(*numbers: int) -> int:
    """Return the seed of, say, an item and an epoch of a run: close numbers have unrelated ones."""
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])
