"""Simulation-based calibration: is a sampler's posterior the model's? (Talts et al. 2018)

The truth is a draw from the prior and the data are made from it, so that among independent draws
of the exact posterior the truth's rank is uniform. That needs no Gaussian and no large number of
runs.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.stats import chisquare


def ranks(
    truth: Float[np.ndarray, "runs k"], draws: Float[np.ndarray, "runs s k"], kept: int
) -> Int[np.ndarray, "runs k"]:
    """Rank of the truth, 0 to `kept`, among `kept` draws evenly thinned from all of a run.

    Raises ValueError where there are not so many draws.
    """
    count = draws.shape[1]
    if not 1 <= kept <= count:
        raise ValueError(f"kept must be 1 to the {count} draws there are, not {kept}")
    chosen = np.round(np.linspace(0, count - 1, kept)).astype(int)
    return np.sum(draws[:, chosen] < truth[:, None], axis=1)


def uniformity(
    ranks: Int[np.ndarray, "runs k"], kept: int, bins: int = 10
) -> tuple[Int[np.ndarray, "k bins"], Float[np.ndarray, " k"]]:
    """Histograms of ranks and the χ² p-value that they are uniform.

    Raises ValueError unless the `kept` + 1 ranks go evenly into the bins.
    """
    if (kept + 1) % bins:
        raise ValueError(f"{kept + 1} ranks do not go evenly into {bins} bins")
    width = (kept + 1) // bins
    histograms = np.stack([np.bincount(r // width, minlength=bins) for r in ranks.T])
    return histograms, np.asarray(chisquare(histograms, axis=1).pvalue)
