"""How sure a mean over learners is: the percentile bootstrap.

Efron and Tibshirani, An Introduction to the Bootstrap (1993), section 13.3.
"""

import numpy as np
from jaxtyping import Float

RESAMPLES = 2000
LEVEL = 0.95  # probability that the interval covers the mean


def bootstrap_interval(
    values: Float[np.ndarray, "*batch learners"],
) -> tuple[Float[np.ndarray, "*batch"], Float[np.ndarray, "*batch"]]:
    """95 % interval of the mean over the last dimension.

    The resampling is seeded: the same values give the same interval. Fewer than about five values make it too
    narrow, one makes it a point.

    Args:
        values: independent results, in any unit.

    Returns:
        Lower and upper end, in the unit of the values.
    """
    learners = values.shape[-1]
    generator = np.random.default_rng(0)
    # How often each learner is drawn replaces the draws: a product of matrices instead of a gather.
    counts = generator.multinomial(learners, np.full(learners, 1 / learners), size=RESAMPLES)
    means = values @ (counts.T / learners)  # [*batch, RESAMPLES]
    tail = (1 - LEVEL) / 2
    low, high = np.quantile(means, [tail, 1 - tail], axis=-1)
    return np.asarray(low), np.asarray(high)
