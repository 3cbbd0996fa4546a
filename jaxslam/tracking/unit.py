"""A map's unit of length while the filter has none that lasts: its landmarks do not move."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Float

Nearness = Mapping[int, float]
"""By a landmark's number: one by its distance from where the map begins, in the filter's unit."""


def nearness(numbers: Mapping[int, int], points: Float[np.ndarray, "n 3"]) -> Nearness:
    """Of landmarks whose numbers are given by their slots, at points in the frame in which the map
    begins."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):  # at infinity, or nowhere
        near = 1 / np.linalg.norm(points, axis=1)
    return {number: float(near[slot]) for slot, number in numbers.items()}


def lengthened(before: Nearness, now: Nearness, among: Iterable[int]) -> float:
    """Log of by how much longer the filter's unit is now than it was before.

    What pixels tell of a camera that sets out are the products t ω, and it is the mean of the ω
    that is taken to be the same, of those landmarks `among` these that are known both times. Zero
    where nothing tells.
    """
    pairs = np.array([(before[n], now[n]) for n in among if n in before and n in now])
    old, new = pairs[np.isfinite(pairs).all(axis=1)].sum(axis=0) if len(pairs) else (0.0, 0.0)
    return float(np.log(new / old)) if old > 0 and new > 0 else 0.0
