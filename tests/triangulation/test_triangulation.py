"""A point seen twice: truth against quadrature, estimates against what they must be, distances."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import ks_2samp, norm, wasserstein_distance

from jaxslam.cli import main
from jaxslam.triangulation import (
    ESTIMATES,
    TwoViews,
    compare,
    distance,
    estimate,
    marginal,
    measure,
    particles,
    push,
    quantiles,
)

PROBABILITIES = np.array([0.005, 0.05, 0.25, 0.5, 0.75, 0.95, 0.995])
COUNT = 2**17


def true_depths(views, kind="triangulation"):
    truth = particles(views, jnp.array(views.pixels), COUNT, 0)[kind]
    return marginal(truth.z, truth.weight)


def estimated_depths(name, views):
    pushed = push(name, estimate(name, views, jnp.array(views.pixels)), COUNT, 0)
    return marginal(pushed.z, pushed.weight)


@pytest.mark.parametrize(
    ("views", "at", "expected"),
    [
        (TwoViews(), slice(None), [11.7, 12.7, 14.0, 15.0, 16.2, 18.3, 20.9]),
        (TwoViews(calibration="shared"), [0, -1], [14.4, 15.7]),
        (TwoViews(depth=2.5), [0, -1], [2.39, 2.63]),
    ],
)
def test_true_depths_have_the_published_quantiles(views, at, expected):
    rounding = 0.05 if views.depth > 10 else 0.005
    found = quantiles(true_depths(views), PROBABILITIES)[at]
    np.testing.assert_allclose(found, expected, rtol=0.003, atol=rounding)


def focal_nodes(views):
    """Nodes of two Gaussian focal lengths, and their weights."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(15)
    grids = np.meshgrid(*[views.focal + views.focal_sigma * nodes] * 2, indexing="ij")
    return *grids, weights / weights.sum()


def test_particles_agree_with_quadrature_over_the_focal_lengths():
    views = TwoViews(depth=6.0, pixel=560.0, baseline=0.9, nearest_depth=2.0)
    # Given both focal lengths the bearings are Gaussian, and so is their difference baseline/z.
    f1, f2, weights = focal_nodes(views)
    mean = (views.pixels[0] - views.centre) / f1 - (views.pixels[1] - views.centre) / f2
    sigma = np.hypot(views.pixel_sigma, views.centre_sigma) * np.hypot(1 / f1, 1 / f2)
    for share, depth in zip(
        PROBABILITIES, quantiles(true_depths(views), PROBABILITIES), strict=True
    ):
        nearer = 1 - ndtr((views.baseline / depth - mean) / sigma)
        assert weights @ nearer @ weights == pytest.approx(share, abs=0.001)


def test_the_posterior_agrees_with_bayes_on_a_grid_of_inverse_depth():
    # The likelihood of the second pixel, the first taken as the ideal one plus noise.
    nearest_depth = 1.0
    views = TwoViews(nearest_depth=nearest_depth, pixel=500.0)
    f1, f2, weights = focal_nodes(views)
    inverse = np.linspace(0.02, 0.12, 4001)[:, None, None]
    bearing = (views.pixels[0] - views.centre) / f1
    predicted = f2 * (bearing - views.baseline * inverse) + views.centre
    sigma = np.hypot(views.pixel_sigma, views.centre_sigma) * np.hypot(1, f2 / f1)
    likelihood = norm.pdf(views.pixels[1], predicted, sigma) @ weights @ weights
    inverse = inverse.ravel()
    density = likelihood * norm.pdf(inverse, 1 / (2 * nearest_depth), 1 / (4 * nearest_depth))
    nearer = (np.cumsum(density[::-1])[::-1] - density / 2) / density.sum()
    found = quantiles(true_depths(views, "posterior"), PROBABILITIES)
    np.testing.assert_allclose(np.interp(1 / found, inverse, nearer), PROBABILITIES, atol=0.001)


def test_inverse_scaling_is_exact_where_the_calibration_is_known():
    # Its observation is then linear: the filter's Gaussian is Bayes's, on the axis and off it.
    views = TwoViews(depth=2.5, pixel=620.0, calibration="known")
    truth = true_depths(views, "posterior")
    assert distance(estimated_depths("inverse_scaling", views), truth, 100.0).ks < 0.001
    assert distance(estimated_depths("inverse_depth", views), truth, 100.0).ks > 0.003


def test_little_noise_makes_every_estimate_the_truth():
    views = TwoViews(pixel_sigma=0.003, calibration="known")
    sigma = views.depth**2 / (views.focal * views.baseline) * np.sqrt(2) * views.pixel_sigma
    expected = views.depth + sigma * norm.ppf(PROBABILITIES)
    for depths in (true_depths(views), *(estimated_depths(name, views) for name in ESTIMATES)):
        found = quantiles(depths, PROBABILITIES)
        np.testing.assert_allclose(found, expected, rtol=0, atol=0.03 * sigma)


def test_a_shared_calibration_correlates_the_cartesian_estimate():
    views = TwoViews(calibration="shared")
    (x, z), covariance = estimate("cartesian", views, jnp.array(views.pixels))
    assert (float(x), float(z)) == pytest.approx(views.point)
    f, b, d = views.focal, views.baseline, views.depth
    # z = f b / (u₁ − u₂): the principal point cancels, the focal length scales.
    variance = 2 * (d**2 / (f * b) * views.pixel_sigma) ** 2 + (d / f * views.focal_sigma) ** 2
    assert float(covariance[1, 1]) == pytest.approx(variance, rel=1e-9)


def test_measurements_err_as_the_calibration_says():
    white = np.array(measure(TwoViews(), 4000, 0))
    shared = np.array(measure(TwoViews(calibration="shared"), 4000, 0))
    known = np.array(measure(TwoViews(calibration="known"), 4000, 0))
    # Rounding of hundreds of pixels: the two are compiled for other sizes.
    np.testing.assert_allclose(white[:7], measure(TwoViews(), 7, 0), rtol=0, atol=1e-10)
    np.testing.assert_allclose(white.mean(axis=0), TwoViews().pixels, atol=0.15)
    assert abs(np.corrcoef(white.T)[0, 1]) < 0.06
    assert np.corrcoef(shared.T)[0, 1] > 0.95
    np.testing.assert_allclose(known.std(axis=0), 0.3, rtol=0.05)


def test_distances_and_quantiles_agree_with_scipy():
    random = np.random.default_rng(0)
    a, b = random.normal(size=500), random.normal(0.3, 1.2, 700)
    weight = random.uniform(0.5, 2.0, 700)
    ones = np.ones(500)
    plain = distance(marginal(a, ones), marginal(b, np.ones(700)), 100.0)
    assert plain.ks == pytest.approx(ks_2samp(a, b).statistic)
    assert plain.wasserstein == pytest.approx(wasserstein_distance(a, b))
    weighted = distance(marginal(a, ones), marginal(b, weight), 100.0)
    assert weighted.wasserstein == pytest.approx(wasserstein_distance(a, b, v_weights=weight))
    near = distance(marginal(a, ones), marginal(b, weight), 0.5)
    clipped = wasserstein_distance(a.clip(-0.5, 0.5), b.clip(-0.5, 0.5), v_weights=weight)
    assert near.wasserstein == pytest.approx(clipped)
    assert distance(marginal(a, ones), marginal(a, ones), 100.0) == (0.0, 0.0)
    expected = np.quantile(a, PROBABILITIES, method="inverted_cdf")
    np.testing.assert_array_equal(quantiles(marginal(a, ones), PROBABILITIES), expected)


def test_a_ray_beyond_infinity_counts_as_infinitely_far():
    views = TwoViews(depth=60.0, baseline=0.2)
    truth = particles(views, jnp.array(views.pixels), COUNT, 0)["triangulation"]
    # The disparity is 2.17 ± 2.86 pixels.
    assert truth.beyond_infinity == pytest.approx(ndtr(-2.167 / 2.861), abs=0.003)
    assert np.all(truth.z > 0)
    assert quantiles(marginal(truth.z, truth.weight), np.array([0.9]))[0] == np.inf


def test_a_prior_that_denies_the_point_leaves_few_particles_and_no_nan():
    views = TwoViews(depth=2.5, nearest_depth=100.0)
    posterior = particles(views, jnp.array(views.pixels), 2000, 0)["posterior"]
    assert np.isfinite(posterior.weight).all()
    assert 1 <= posterior.effective < 20


def test_single_precision_is_as_evenly_spread():
    expected = quantiles(true_depths(TwoViews()), PROBABILITIES)
    with jax.enable_x64(False):
        found = quantiles(true_depths(TwoViews()), PROBABILITIES)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, rtol=2e-4)


def test_samples_do_not_depend_on_the_chunk(monkeypatch):
    views = TwoViews()
    whole = particles(views, jnp.array(views.pixels), 5000, 3)["posterior"]
    monkeypatch.setattr("jaxslam.triangulation._CHUNK", 2048)
    parts = particles(views, jnp.array(views.pixels), 5000, 3)["posterior"]
    for a, b in zip(whole, parts, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: TwoViews(depth=-1.0), "depth must be positive, not -1.0"),
        (lambda: TwoViews(nearest_depth=float("nan")), "nearest_depth must be finite, not nan"),
        (lambda: TwoViews(pixel=640.0), "pixel must be in the image, from 0 to 640"),
        (lambda: TwoViews(depth=1.0), "depth must be at least 1.219"),
        (lambda: TwoViews(calibration="wite"), "did you mean white"),
        (lambda: TwoViews(focal_sigma=-1.0), "focal_sigma must not be negative"),
        (lambda: compare(TwoViews(), particles=10), "particles must be at least 1000, not 10"),
        (lambda: compare(TwoViews(), measurements=1), "measurements must be 0"),
    ],
)
def test_what_makes_no_sense_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_the_command_writes_what_others_read(tmp_path, capsys):
    """Of a point whose ray may be beyond infinity."""
    small = ["--particles", "3000", "--measurements", "3", "--calibration", "white"]
    far = ["--depth", "60", "--baseline", "0.2", "--nearest-depth", "2"]
    main(["triangulate", *small, *far, "--out", str(tmp_path)])
    summary = json.loads((tmp_path / "triangulation.json").read_text())
    assert summary["schema"] == 1
    views = TwoViews(depth=60.0, baseline=0.2, nearest_depth=2.0)
    assert summary["views"] == dataclasses.asdict(views)
    assert summary["farthest"] == pytest.approx(10 * views.depth)
    assert summary["truth"]["triangulation"]["z"][-1] is None
    assert summary["truth"]["triangulation"]["beyond_infinity"] > 0.1
    assert (summary["particles"], summary["measurements"], summary["seed"]) == (3000, 3, 0)
    assert set(summary["truth"]) == {"triangulation", "posterior"}
    assert set(summary["estimates"]) == set(ESTIMATES)
    for result in (*summary["truth"].values(), *summary["estimates"].values()):
        assert len(result["x"]) == len(result["z"]) == len(summary["probabilities"])
    found = summary["estimates"]["inverse_scaling"]["distance"]["posterior"]["z"]
    for of in found.values():
        assert of.keys() == {"exact", "mean", "error"}
    assert (tmp_path / "triangulation.png").read_bytes().startswith(b"\x89PNG")
    assert {path.name for path in tmp_path.iterdir()} == {"triangulation.json", "triangulation.png"}
    printed = capsys.readouterr().out
    assert "inverse_depth" in printed
    assert "∞" in printed
