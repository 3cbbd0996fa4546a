"""Every estimate against the truth: at the exact pixels, and on average over measured ones."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxslam.triangulation.estimates import ESTIMATES, estimate, push
from jaxslam.triangulation.samples import Distance, Marginal, Samples, distance, marginal, quantiles
from jaxslam.triangulation.truth import particles as true_particles
from jaxslam.triangulation.views import TwoViews, measure

SCHEMA = 1
PROBABILITIES = (0.005, 0.05, 0.25, 0.5, 0.75, 0.95, 0.995)
COORDINATES = ("x", "z")
FARTHEST = 10.0
"""Times the true depth: a point beyond counts as that far in Wasserstein distances."""
MOST = 10**8
"""Particles that a machine holds."""
PARTICLES, LEAST_PARTICLES = 1_000_000, 1000
MEASUREMENTS = 100
AVERAGED_PARTICLES = 2**16
"""Particles for each measurement of an average, at most: its error is 0.001 in a KS distance,
and the measurements' own scatter is larger."""

Distances = dict[str, dict[str, dict[str, Distance]]]
"""By estimate, truth and coordinate."""


@dataclass(frozen=True)
class Comparison:
    """Truth and estimates as samples at the exact pixels, and distances for noisy ones."""

    views: TwoViews
    """What was seen, from where."""
    particles: int
    """So many are the truth."""
    seed: int
    """Of the particles and of the pixels' noise."""
    truth: Mapping[str, Samples]
    """`triangulation`, of the pixels alone, and `posterior`, with the filters' prior."""
    estimates: Mapping[str, Samples]
    """By parametrization."""
    exact: Distances
    """Of the estimates from the pixels without noise."""
    measured: tuple[Distances, ...]
    """Of those from noisy pixels, one for each measurement."""


def compare(
    views: TwoViews,
    *,
    particles: int = PARTICLES,
    measurements: int = MEASUREMENTS,
    seed: int = 0,
    progress: Callable[[int], None] = lambda done: None,
) -> Comparison:
    """Compare all estimates with both truths, in float64.

    `progress(1)` is called after each measurement. Raises ValueError for sizes that make no sense.
    """
    check_sizes(particles, measurements, seed)
    few = min(particles, AVERAGED_PARTICLES)
    measured = []
    with jax.enable_x64(True):
        truth, estimates = next(_each(views, jnp.array([views.pixels]), particles, seed))
        exact = _distances(views, truth, estimates)
        for pair in _each(views, measure(views, measurements, seed), few, seed):
            measured.append(_distances(views, *pair))
            progress(1)
    return Comparison(views, particles, seed, truth, estimates, exact, tuple(measured))


def summarise(comparison: Comparison) -> dict[str, Any]:
    """The content of `triangulation.json`, ready for `json.dumps`; what is infinite is None."""
    from jaxslam._version import __version__

    views = comparison.views
    return {
        "schema": SCHEMA,
        "version": __version__,
        "views": dataclasses.asdict(views),
        "pixels": list(views.pixels),
        "point": list(views.point),
        "particles": comparison.particles,
        "measurements": len(comparison.measured),
        "seed": comparison.seed,
        "farthest": FARTHEST * views.depth,
        "probabilities": list(PROBABILITIES),
        "truth": {name: _spread(s) for name, s in comparison.truth.items()},
        "estimates": {
            name: {**_spread(s), "distance": _summarise_distances(comparison, name)}
            for name, s in comparison.estimates.items()
        },
    }


def table(summary: dict[str, Any]) -> str:
    """The depths of a summary as text: quantiles, and the distances of every estimate."""
    levels = "".join(f"{100 * p:>8g} %" for p in summary["probabilities"])
    lines = [f"{'depth z, m':<18}{levels}{'beyond ∞':>11}"]
    for name, spread in {**summary["truth"], **summary["estimates"]}.items():
        depths = "".join(f"{_number(value):>10}" for value in spread["z"])
        lines.append(f"{name:<18}{depths}{spread['beyond_infinity']:>11.2%}")
    average = f"mean of {summary['measurements']}" if summary["measurements"] else ""
    heads = "".join(f"{head:>16}{average:>18}" for head in ("KS", "Wasserstein, m"))
    lines.append(f"\n{'distance in z to':<18}{'truth':<14}{heads}")
    for name, result in summary["estimates"].items():
        for truth, by_coordinate in result["distance"].items():
            columns = "".join(_distance_columns(by_coordinate["z"][m]) for m in Distance._fields)
            lines.append(f"{name:<18}{truth:<14}{columns}")
    return "\n".join(lines)


def check_sizes(particles: int, measurements: int, seed: int) -> None:
    """Raise ValueError for sizes that make no sense."""
    if particles < LEAST_PARTICLES:
        raise ValueError(f"particles must be at least {LEAST_PARTICLES}, not {particles}")
    for name, count in (("particles", particles), ("measurements", measurements)):
        if count > MOST:
            raise ValueError(f"{name} must be at most {MOST}, not {count}")
    if seed >= 2**63:
        raise ValueError(f"seed must be below 2⁶³, not {seed}")
    if measurements < 0 or measurements == 1:
        raise ValueError(
            f"measurements must be 0 (no average) or at least 2 (for its error), not {measurements}"
        )
    if seed < 0:
        raise ValueError(f"seed must not be negative, not {seed}")


def _each(
    views: TwoViews, pixels: Float[Array, "m 2"], count: int, seed: int
) -> Iterator[tuple[dict[str, Samples], dict[str, Samples]]]:
    """Truths and estimates of each pair of pixels, as `count` samples."""
    for pair in pixels:
        estimates = {
            name: push(name, estimate(name, views, pair), count, seed) for name in ESTIMATES
        }
        yield true_particles(views, pair, count, seed), estimates


def _distances(
    views: TwoViews, truth: Mapping[str, Samples], estimates: Mapping[str, Samples]
) -> Distances:
    farthest = FARTHEST * views.depth
    true, estimated = _marginals(truth), _marginals(estimates)
    return {
        name: {
            kind: {c: distance(of[c], against[c], farthest) for c in COORDINATES}
            for kind, against in true.items()
        }
        for name, of in estimated.items()
    }


def _marginals(distributions: Mapping[str, Samples]) -> dict[str, dict[str, Marginal]]:
    return {
        name: {c: marginal(getattr(s, c), s.weight) for c in COORDINATES}
        for name, s in distributions.items()
    }


def _spread(of: Samples) -> dict[str, Any]:
    """Quantiles of both coordinates, the share beyond infinity, what weights leave."""
    spread: dict[str, Any] = {
        "beyond_infinity": of.beyond_infinity,
        "effective_particles": of.effective,
    }
    for coordinate in COORDINATES:
        values = quantiles(marginal(getattr(of, coordinate), of.weight), np.array(PROBABILITIES))
        spread[coordinate] = [float(v) if np.isfinite(v) else None for v in values]
    return spread


def _summarise_distances(comparison: Comparison, name: str) -> dict[str, Any]:
    """Distances by truth, coordinate and measure: at the exact pixels, and their mean."""
    return {
        truth: {
            c: {
                measure: {
                    "exact": getattr(of[c], measure),
                    **_average([getattr(d[name][truth][c], measure) for d in comparison.measured]),
                }
                for measure in Distance._fields
            }
            for c in COORDINATES
        }
        for truth, of in comparison.exact[name].items()
    }


def _average(values: list[float]) -> dict[str, float | None]:
    """Mean and its standard error."""
    if not values:
        return {"mean": None, "error": None}
    return {
        "mean": float(np.mean(values)),
        "error": float(np.std(values, ddof=1) / np.sqrt(len(values))),
    }


def _number(value: float | None) -> str:
    return "∞" if value is None else f"{value:.4g}"


def _distance_columns(of: dict[str, float | None]) -> str:
    if of["mean"] is None:
        return f"{of['exact']:>16.4f}{'':>18}"
    return f"{of['exact']:>16.4f}{of['mean']:>9.4f} ± {of['error']:.4f}"
