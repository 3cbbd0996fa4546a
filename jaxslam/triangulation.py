"""A point seen from two places: each parametrization's estimate against the truth (Figs 1 and 2).

`compare(TwoViews(depth=15.0))`, then `summarise` and `table`, as `jaxslam triangulate` does. The
world is planar and its camera 1-D, `u = f x/z + c`. The second view is a known baseline to the
right of the first, without a rotation. The point is written (x, z) in the second camera.

*Truth* by particles: in *triangulation*, the paper's, two rays meet, through the measured pixels
less their noise and with intrinsics as they may be. In *posterior* the same particles are weighted
by the prior on inverse depth that Inverse Scaling and Unified Inverse Depth use. *Estimates* are
Gaussians of a landmark's parameters: of the robocentric filter, or, of a Cartesian point, of
first-order triangulation. Pushed through `homogeneous` they bend as the parametrization does.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtri
from jaxtyping import Array, Float, Int, PyTree, UInt32

from jaxslam._runtime.files import Json
from jaxslam._runtime.lookup import lookup
from jaxslam._version import __version__
from jaxslam.filters.slam import Slam
from jaxslam.geometry import PLANAR, Scalar
from jaxslam.landmarks import LANDMARKS
from jaxslam.linalg import semidefinite_root
from jaxslam.models.calibration import Estimated, Known, White
from jaxslam.models.camera import Camera, project, ray
from jaxslam.models.depth import InverseDepth
from jaxslam.models.motion import ConstantVelocity
from jaxslam.models.observations import Features
from jaxslam.models.sensors import Pinhole
from jaxslam.simulation import BUILT_IN

__all__ = [
    "CALIBRATIONS", "ESTIMATES", "Comparison", "Samples", "TwoViews", "compare", "distance",
    "estimate", "marginal", "measure", "particles", "push", "quantiles", "shares_up_to",
    "summarise", "table",
]  # fmt: skip

_MATCHED = BUILT_IN["matched"].fields
CALIBRATIONS = {"white": White, "shared": Estimated, "known": lambda sigma: Known()}
"""How the true intrinsics are drawn (in each view, once for both, or not at all), and how a filter
that knows this treats them."""
ESTIMATES = ("inverse_scaling", "inverse_depth", "cartesian")
"""The names of the estimates, which are those of their parametrizations."""
PARTICLES, MEASUREMENTS = 1_000_000, 100
PROBABILITIES = (0.005, 0.05, 0.25, 0.5, 0.75, 0.95, 0.995)
_NOISE_DIM = 6  # of a sample: two pixel errors and two errors of (f, c)
_CHUNK = 2**16  # samples computed at once, which bounds the memory beyond the result

Values = Float[np.ndarray, " n"]
Gaussian = tuple[Float[Array, " d"], Float[Array, "d d"]]
Point = tuple[Float[Array, " 2"], Scalar, Scalar]
"""A homogeneous point (X, ω) and the logarithm of its weight."""
Summary = dict[str, Json]


class TwoViews(eqx.Module):
    """A point, two cameras that see it, and what is known of them.

    Raises ValueError, naming the field, unless both views can see the point.
    """

    depth: float = 15.0
    """The true z of the point, m."""
    baseline: float = 0.6
    """The sideways motion between the views, exactly known, m."""
    pixel: float = _MATCHED["centre"][0]
    """The pixel of the point in the first view; the principal point is on the axis."""
    nearest_depth: float = 1.0
    """d_min, m: the filters' prior on 1/z is N(1/(2 d_min), (1/(4 d_min))²)."""
    calibration: str = eqx.field(default="white", static=True)
    """`white`: intrinsics drawn in each view; `shared`: once for both; `known`: exact."""
    width: float = _MATCHED["image"][0]
    """The width of the picture, pixels."""
    focal: float = _MATCHED["focal"][0]
    """The focal length, pixels."""
    centre: float = _MATCHED["centre"][0]
    """The principal point, pixels."""
    focal_sigma: float = _MATCHED["focal_sigma"]
    """σ of the focal length, pixels."""
    centre_sigma: float = _MATCHED["centre_sigma"]
    """σ of the principal point, pixels."""
    pixel_sigma: float = _MATCHED["pixel_sigma"]
    """σ of a measured pixel."""

    def __check_init__(self) -> None:
        lookup("calibration", self.calibration, CALIBRATIONS)
        least = dict.fromkeys(("focal_sigma", "centre_sigma"), 0.0) | {"pixel": -1, "centre": -1}
        for field, value in dataclasses.asdict(self).items():
            if field != "calibration" and not math.isfinite(value):
                raise ValueError(f"{field} must be finite, not {value}")
            if field not in ("calibration", *least) and value <= 0:
                raise ValueError(f"{field} must be positive, not {value}")
            if least.get(field) == 0 and value < 0:
                raise ValueError(f"{field} must not be negative, not {value}")
        if not 0 <= self.pixel < self.width:
            raise ValueError(f"pixel must be in the image, from 0 to {self.width:g}: {self.pixel}")
        if self.pixels[1] < 0:
            nearest = self.focal * self.baseline / self.pixel if self.pixel else math.inf
            raise ValueError(
                f"the second view does not see the point at pixel {self.pixel:g} and depth "
                f"{self.depth:g}: depth must be at least {nearest:.4g}, or the pixel larger"
            )

    @property
    def pixels(self) -> tuple[float, float]:
        """The pixels at which both views see the point, with the nominal camera and no noise."""
        return self.pixel, self.pixel - self.focal * self.baseline / self.depth

    @property
    def point(self) -> tuple[float, float]:
        """The point (x, z) in the second camera, m."""
        return (self.pixels[1] - self.centre) / self.focal * self.depth, self.depth

    @property
    def sensor(self) -> Pinhole:
        """The nominal camera, with the noise of its pixels."""
        return Pinhole(Camera(jnp.stack([self.focal]), jnp.stack([self.centre])), self.pixel_sigma)

    @property
    def intrinsics_sigma(self) -> Float[Array, " 2"]:
        """σ of (f, c), pixels."""
        return jnp.stack([self.focal_sigma, self.centre_sigma])

    def errors(self, normal: Float[Array, " n"]) -> tuple[Float[Array, " 2"], Camera]:
        """Return the errors of the pixels and both true cameras, stacked, from normal numbers."""
        by_view = {
            "white": normal[2:].reshape(2, 2),
            "shared": jnp.tile(normal[2:4], (2, 1)),
            "known": jnp.zeros((2, 2), normal.dtype),
        }[self.calibration]
        cameras = jax.vmap(self.sensor.camera.perturbed)(by_view * self.intrinsics_sigma)
        return self.pixel_sigma * normal[:2], cameras


def measure(views: TwoViews, count: int, seed: int) -> Float[Array, "count 2"]:
    """Draw `count` measured pairs of pixels; pair i depends on `seed` and i alone."""
    x, z = views.point
    points = jnp.array([[x + views.baseline, z], [x, z]])

    def one(index):
        key = jax.random.fold_in(jax.random.key(seed), index)
        errors, cameras = views.errors(jax.random.normal(key, (_NOISE_DIM,)))
        return jax.vmap(project)(cameras, points)[:, 0] + errors

    return jax.vmap(one)(jnp.arange(count))


class Samples(NamedTuple):
    """Weighted points in the second camera, m; one at or beyond infinity is infinite."""

    x: Values
    z: Values
    weight: Values

    @property
    def beyond_infinity(self) -> float:
        """The share of the points that are at infinity or beyond (ω ≤ 0)."""
        return float(self.weight[np.isinf(self.z)].sum() / self.weight.sum())

    @property
    def effective(self) -> float:
        """The effective number of samples, `(Σw)² / Σw²`."""
        return float(self.weight.sum() ** 2 / (self.weight**2).sum())


def _draw(
    sampler: Callable[..., Point], name: str, data: PyTree[Array | float], count: int, seed: int
) -> Samples:
    """Draw `count` samples of `sampler(name, data, standard normal numbers)`."""
    size = min(count, _CHUNK)
    shift = jax.random.bits(jax.random.key(seed), (_NOISE_DIM,), jnp.uint32)
    chunks = [_chunk(sampler, name, data, shift, start, size) for start in range(0, count, size)]
    x, z, log_weight = (np.concatenate(part)[:count] for part in zip(*chunks, strict=True))
    return Samples(x, z, np.exp(log_weight - log_weight.max()))


@partial(jax.jit, static_argnames=("sampler", "name", "size"))
def _chunk(sampler, name, data, shift, start, size):
    normals = _standard_normals(shift, start + jnp.arange(size))
    points, omegas, log_weights = jax.vmap(partial(sampler, name, data))(normals)
    # Beyond infinity a point is where its ray ends, not behind the camera where X/ω would be.
    seen = omegas > 0
    safe = jnp.where(seen, omegas, 1.0)[:, None]
    x, z = jnp.where(seen[:, None], points / safe, jnp.sign(points) * jnp.inf).T
    return x, z, log_weights


def _standard_normals(shift: UInt32[Array, " d"], indices: Int[Array, " n"]) -> Float[Array, "n d"]:
    """Kronecker's sequence `frac(shift + i α)` through the normal quantile: ten times fewer do.

    α_j = φ^-j, φ the root of φ^(d+1) = φ + 1 (Roberts 2018); the shift is random (Cranley and
    Patterson 1976).
    """
    phi = 2.0
    for _ in range(60):
        phi = (1 + phi) ** (1 / (shift.size + 1))
    alpha = np.round(phi ** -np.arange(1.0, shift.size + 1) * 2**32).astype(np.uint32)
    # Integers wrap at 2³², which is frac() without rounding, in single precision too.
    turns = shift + indices.astype(jnp.uint32)[:, None] * alpha
    uniform = (turns.astype(float) + 0.5) / 2.0**32
    eps = jnp.finfo(uniform.dtype).eps
    return ndtri(jnp.clip(uniform, eps, 1 - eps))


def _intersect(_: str, given: tuple[TwoViews, Array], normal: Float[Array, " n"]) -> Point:
    """The point where two rays meet: (x, z, ω) = (b₂, 1, (b₁ − b₂)/baseline), b = (u − c)/f.

    Its weight is the posterior's density relative to that of the particles, without constants:
    `N(1/z) / f₂`, the prior and |∂(1/z)/∂u₂|. The prior is flat in the first pixel.
    """
    views, pixels = given
    errors, cameras = views.errors(normal)
    first, second = jax.vmap(ray)(cameras, (pixels + errors)[:, None])[:, 0]
    inverse_depth = (first - second) / views.baseline
    prior = InverseDepth.beyond(views.nearest_depth)
    log_weight = -(((inverse_depth - prior.mean) / prior.sigma) ** 2) / 2
    log_weight -= jnp.log(cameras.focal[1, 0])
    return jnp.stack([second, jnp.ones_like(second)]), inverse_depth, log_weight


def particles(
    views: TwoViews, pixels: Float[Array, " 2"], count: int, seed: int
) -> dict[str, Samples]:
    """Draw the truths `triangulation` and `posterior` given two measured pixels."""
    posterior = _draw(_intersect, "", (views, pixels), count, seed)
    triangulation = posterior._replace(weight=np.ones_like(posterior.weight))
    return {"triangulation": triangulation, "posterior": posterior}


@partial(jax.jit, static_argnames="name")
def estimate(name: str, views: TwoViews, pixels: Float[Array, " 2"]) -> Gaussian:
    """Return the named estimate (mean, covariance) in the second camera from two pixels.

    The filter sees the landmark new, and again after one step of 1 s. The Cartesian point is where
    the measured rays meet, its covariance `J Jᵀ`, J its Jacobian by the standardised errors.
    """
    if name == "cartesian":
        zero = jnp.zeros(_NOISE_DIM)

        def meet(normal):
            numerator, omega, _ = _intersect("", (views, pixels), normal)
            return numerator / omega

        J = jax.jacfwd(meet)(zero)
        return meet(zero), J @ J.T
    zero = jnp.zeros(PLANAR.tangent_dim)
    slam = Slam(
        motion=ConstantVelocity(zero, zero.at[0].set(views.baseline), zero),
        sensor=views.sensor,
        landmark=LANDMARKS[name],
        calibration=CALIBRATIONS[views.calibration](views.intrinsics_sigma),
        depth=InverseDepth.beyond(views.nearest_depth),
    )

    def seen(pixels):
        return Features(jnp.zeros(pixels.size, int), pixels[:, None], jnp.ones(pixels.size, bool))

    state = slam.init(1, seen(pixels[:1]))
    state, _ = slam.step(state, jnp.ones(()), seen(pixels[1:]), seen(pixels[2:]))
    own = slice(state.core_dim, None)
    return state.landmarks[0], state.covariance[own, own]


def _pushed(name: str, gaussian: Gaussian, normal: Float[Array, " n"]) -> Point:
    mean, root = gaussian
    point, omega = LANDMARKS[name].homogeneous(mean + root @ normal[: mean.size])
    return point, omega, jnp.zeros_like(omega)


def push(name: str, gaussian: Gaussian, count: int, seed: int) -> Samples:
    """Draw `count` points of the named estimate."""
    mean, covariance = gaussian
    return _draw(_pushed, name, (mean, jax.jit(semidefinite_root)(covariance).root), count, seed)


class Marginal(NamedTuple):
    """The distribution of one coordinate: the share up to and including each sorted value."""

    values: Values
    shares: Values


class Distance(NamedTuple):
    """The distance between two distributions of one coordinate."""

    ks: float
    """The largest difference of the distribution functions (Kolmogorov and Smirnov)."""
    wasserstein: float
    """The area between the distribution functions, m (Wasserstein-1)."""


def marginal(values: Values, weight: Values) -> Marginal:
    """Sort one coordinate of weighted samples."""
    order = np.argsort(values)
    shares = np.cumsum(weight[order])
    return Marginal(values[order], shares / shares[-1])


def quantiles(of: Marginal, probabilities: Values) -> Values:
    """Return the smallest values that have at least these shares up to and including them."""
    found = np.searchsorted(of.shares, probabilities)
    return of.values[np.minimum(found, of.values.size - 1)]  # the last share may round below 1


def shares_up_to(of: Marginal, values: Values) -> Values:
    """Evaluate the distribution function."""
    return np.append(0.0, of.shares)[np.searchsorted(of.values, values, side="right")]


def distance(a: Marginal, b: Marginal, farthest: float) -> Distance:
    """Compute both distances, exact for the samples.

    For Wasserstein's, values are clipped to ±`farthest`: where 1/z is Gaussian, z has no mean.
    """
    values = np.sort(np.concatenate([a.values, b.values]), kind="stable")
    difference = np.abs(shares_up_to(a, values) - shares_up_to(b, values))
    lengths = np.diff(np.clip(values, -farthest, farthest))
    return Distance(float(difference.max()), float(difference[:-1] @ lengths))


class Comparison(NamedTuple):
    """Truth and estimates as samples at the exact pixels, and distances at noisy ones."""

    views: TwoViews
    particles: int
    seed: int
    truth: Mapping[str, Samples]
    """`triangulation`, of the pixels alone, and `posterior`, with the filters' prior."""
    estimates: Mapping[str, Samples]
    """The estimates by parametrization."""
    distances: list[dict[tuple[str, str, str], Distance]]
    """The distances by estimate, truth and coordinate: at the exact pixels, then at each pair."""


def compare(
    views: TwoViews,
    *,
    particles: int = PARTICLES,
    measurements: int = MEASUREMENTS,
    seed: int = 0,
    progress: Callable[[int], None] = lambda done: None,
) -> Comparison:
    """Compare all estimates with both truths, in float64.

    `progress(1)` is called after each measurement. Raises ValueError for impossible sizes.
    """
    check_sizes(particles, measurements, seed)
    with jax.enable_x64(True):
        truth, estimates, exact = _compared(views, jnp.array(views.pixels), particles, seed)
        distances = [exact]
        for pixels in measure(views, measurements, seed):
            # So many have an error of 0.001 in a KS distance, less than the measurements' scatter.
            distances.append(_compared(views, pixels, min(particles, 2**16), seed)[2])
            progress(1)
    return Comparison(views, particles, seed, truth, estimates, distances)


def check_sizes(particles: int, measurements: int, seed: int) -> None:
    """Raise ValueError for impossible sizes."""
    limits = {"particles": (particles, 1000, 10**8), "measurements": (measurements, 0, 10**8)}
    for name, (value, least, most) in {**limits, "seed": (seed, 0, 2**63 - 1)}.items():
        if not least <= value <= most:
            bound = f"at least {least}" if value < least else f"at most {most}"
            raise ValueError(f"{name} must be {bound}, not {value}")
    if measurements == 1:
        raise ValueError("measurements must be 0 (no average) or at least 2 (for its error), not 1")


def _compared(views, pixels, count, seed):
    truth = particles(views, pixels, count, seed)
    estimates = {n: push(n, estimate(n, views, pixels), count, seed) for n in ESTIMATES}
    true = {kind: _marginals(of) for kind, of in truth.items()}
    return truth, estimates, {
        (name, kind, c): distance(own, against[c], _farthest(views))
        for name, of in estimates.items()
        for c, own in _marginals(of).items()
        for kind, against in true.items()
    }  # fmt: skip


def _farthest(views: TwoViews) -> float:
    """The limit of Wasserstein distances, m."""
    return 10 * views.depth


def _marginals(of: Samples) -> dict[str, Marginal]:
    return {"x": marginal(of.x, of.weight), "z": marginal(of.z, of.weight)}


def summarise(comparison: Comparison) -> Summary:
    """Return the content of `triangulation.json`; what is infinite is None."""
    views = comparison.views

    def distances(of: tuple[str, str, str]) -> Summary:
        exact, *measured = np.array([each[of] for each in comparison.distances])
        mean, error = (None, None), (None, None)
        if measured:
            mean = np.mean(measured, axis=0).tolist()
            error = (np.std(measured, axis=0, ddof=1) / np.sqrt(len(measured))).tolist()
        parts = zip(Distance._fields, exact.tolist(), mean, error, strict=True)
        return {name: dict(zip(("exact", "mean", "error"), x, strict=True)) for name, *x in parts}

    def spread(of: Samples) -> Summary:
        z = {c: quantiles(m, np.array(PROBABILITIES)).tolist() for c, m in _marginals(of).items()}
        return {"beyond_infinity": of.beyond_infinity, "effective_particles": of.effective} | {
            c: [v if math.isfinite(v) else None for v in values] for c, values in z.items()
        }

    return {
        "schema": 1,
        "version": __version__,
        "views": dataclasses.asdict(views),
        "pixels": list(views.pixels),
        "point": list(views.point),
        "particles": comparison.particles,
        "measurements": len(comparison.distances) - 1,
        "seed": comparison.seed,
        "farthest": _farthest(views),
        "probabilities": list(PROBABILITIES),
        "truth": {name: spread(of) for name, of in comparison.truth.items()},
        "estimates": {
            name: spread(of) | {"distance": {
                kind: {c: distances((name, kind, c)) for c in "xz"} for kind in comparison.truth
            }}
            for name, of in comparison.estimates.items()
        },
    }  # fmt: skip


def table(summary: Summary) -> str:
    """Format a summary's quantiles of the depth, and the distances of every estimate."""
    levels = "".join(f"{100 * p:>8g} %" for p in summary["probabilities"])
    lines = [f"{'depth z, m':<18}{levels}{'beyond ∞':>11}"]
    for name, spread in {**summary["truth"], **summary["estimates"]}.items():
        depths = "".join(f"{'∞' if z is None else f'{z:.4g}':>10}" for z in spread["z"])
        lines.append(f"{name:<18}{depths}{spread['beyond_infinity']:>11.2%}")
    average = f"mean of {summary['measurements']}" if summary["measurements"] else ""
    heads = "".join(f"{head:>16}{average:>18}" for head in ("KS", "Wasserstein, m"))
    lines.append(f"\n{'distance in z to':<18}{'truth':<14}{heads}")
    for name, result in summary["estimates"].items():
        for truth, by_coordinate in result["distance"].items():
            columns = ""
            for x in by_coordinate["z"].values():
                mean = "" if x["mean"] is None else f"{x['mean']:>9.4f} ± {x['error']:.4f}"
                columns += f"{x['exact']:>16.4f}{mean:>18}"
            lines.append(f"{name:<18}{truth:<14}{columns}")
    return "\n".join(lines)
