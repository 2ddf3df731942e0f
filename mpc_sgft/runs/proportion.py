"""How sure a share of successes is."""

import math
from statistics import NormalDist

Z = NormalDist().inv_cdf(0.975)


def wilson(hits: float, count: int) -> tuple[float, float]:
    """95 % interval of a share (E. B. Wilson, 1927), without scipy.stats, which takes long to import.

    Returns:
        Its two ends; nan without data.
    """
    if count == 0:
        return math.nan, math.nan
    share, spread = hits / count, Z * Z / count
    centre = (share + spread / 2) / (1 + spread)
    half = math.sqrt(spread * share * (1 - share) + spread**2 / 4) / (1 + spread)
    return max(0.0, centre - half), min(1.0, centre + half)
