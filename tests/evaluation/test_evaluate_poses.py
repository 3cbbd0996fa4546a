"""Poses against the truth: conventions, their checker, alignments, text, folders of runs."""

import json
from dataclasses import replace
from itertools import product

import jax.numpy as jnp
import numpy as np
import pytest
import verdicts as benchmark
from logs import (
    FIXED,
    LOST,
    TRACKED,
    UNFIXED,
    consistent,
    covariance,
    logged,
    planar,
    some,
    tracked_run,
    write_runs,
)  # fmt: skip
from scipy.spatial.transform import Rotation

import jaxslam
from jaxslam.evaluation import Convention, converted, pose_errors
from jaxslam.evaluation.alignment import Similarity, associated, gauge_directions, similarity
from jaxslam.evaluation.comparison import with_truth
from jaxslam.evaluation.convention import (
    CHOICES,
    alternatives,
    change,
    from_right,
    read_covariances,
    truth_derivatives,
    write_covariances,
)  # fmt: skip
from jaxslam.evaluation.convention_search import Tried, identify
from jaxslam.evaluation.inputs import checked_poses
from jaxslam.evaluation.scale import Scale, errors_beyond_scale
from jaxslam.geometry import PLANAR, SPATIAL, difference
from jaxslam.io.tum import write_tum
from jaxslam.plots.evaluation import plot_axis, plot_evaluation, plot_scale
from jaxslam.plots.style import new_figure
from jaxslam.statistics import Tally, not_disproved, run_verdict
from jaxslam.statistics.beyond_scale import one_scale

EVERY = [Convention(*c) for c in product(*list(CHOICES.values())[:3])]
"""Orders are the fastest to change."""
EACH = [*EVERY[::4], *EVERY[3::4]]
"""Errors and axes in one of their two orders, which only permute axes."""
SPLIT = Convention("split")
each_geometry = pytest.mark.parametrize("geometry", [PLANAR, SPATIAL], ids=["plane", "space"])

# --- conventions --------------------------------------------------------------------------------


@each_geometry
def test_right_and_left_errors_are_those_of_the_group(geometry):
    T, truth = some(geometry, (5,)), some(geometry, (5,), 1, 0.5)
    of = geometry.group.from_matrix
    for i in range(5):
        right = difference(of(jnp.asarray(truth[i])), of(jnp.asarray(T[i])))
        np.testing.assert_allclose(pose_errors(Convention(), T, truth)[i], right, atol=1e-12)
        left = of(jnp.asarray(truth[i] @ np.linalg.inv(T[i]))).log()
        np.testing.assert_allclose(pose_errors(Convention("left"), T, truth)[i], left, atol=1e-9)


def test_the_split_error_is_what_ros_and_error_state_filters_have():
    T, truth = some(SPATIAL, (5,)), some(SPATIAL, (5,), 1)
    R, true = T[:, :3, :3], truth[:, :3, :3]
    position = truth[:, :3, 3] - T[:, :3, 3]
    world = Rotation.from_matrix(true @ np.swapaxes(R, 1, 2)).as_rotvec()
    body = Rotation.from_matrix(np.swapaxes(R, 1, 2) @ true).as_rotvec()
    in_body = np.einsum("nji,nj->ni", R, position)
    for axes, moved, turn in (
        ("world", position, world), ("mixed", position, body), ("body", in_body, body)
    ):  # fmt: skip
        expected = np.hstack([moved, turn])
        found = pose_errors(Convention("split", axes), T, truth)
        np.testing.assert_allclose(found, expected, atol=1e-9)
        found = pose_errors(Convention("split", axes, "rotation-first"), T, truth)
        np.testing.assert_allclose(found, np.roll(expected, 3, axis=1), atol=1e-9)


@each_geometry
def test_the_change_of_a_convention_is_the_derivative_of_its_error(geometry):
    T, t, step = some(geometry, (2,)), geometry.tangent_dim, 1e-6
    steps = [np.tile(d, (2, 1)) for d in step * np.eye(t)]
    moved = [benchmark.displaced(T, d, Convention()) for d in steps]
    pitch = np.arcsin(-T[:, 2, 0]) if geometry is SPATIAL else np.zeros(2)
    for convention in EACH:
        J = np.stack([pose_errors(convention, T, x) for x in moved], axis=-1)
        np.testing.assert_allclose(J / step, from_right(convention, T), atol=1e-5)
        volume = 1 / np.cos(pitch) if convention.axes == "rpy" else 1
        determinant = abs(np.linalg.det(from_right(convention, T)))
        np.testing.assert_allclose(determinant, volume, rtol=1e-9)


def test_a_conversion_is_the_same_of_arrays_in_any_order_of_memory():
    T, P, _ = logged(Convention("left"), runs=3)
    turned = np.swapaxes(np.swapaxes(P, 0, 1).copy(), 0, 1)
    found, other = (converted(x, T, Convention("left"), SPLIT) for x in (P, turned))
    np.testing.assert_array_equal(found, other)
    assert np.abs(found - P).max() > 1e-3


@pytest.mark.parametrize("convention", EACH[::2], ids=str)
def test_a_filter_that_is_right_is_consistent_in_its_own_convention(convention):
    """Exactly, by construction, whatever the size of the errors."""
    found = jaxslam.evaluate_poses(*logged(convention), convention)
    assert consistent(found.nees, 6)
    assert found.names[0] == ("x" if convention.order == "position-first" else "rx")
    assert found.identified is not None
    assert convention in found.identified.consistent or not not_disproved(found.verdict)


# --- the checker --------------------------------------------------------------------------------


def test_a_wrong_convention_is_doubted_and_the_right_one_suggested():
    true, stated = Convention("left", order="rotation-first"), Convention("right")
    found = jaxslam.evaluate_poses(*logged(true), stated)
    assert found.suggested == true
    assert found.asdict()["suggested"]["order"] == "rotation-first"
    assert "is doubtful: only with error=left axes=world order=rotation-first" in str(found)
    found = jaxslam.evaluate_poses(*logged(true), true)
    assert found.suggested is None
    assert "of 14 conventions the stated one (error=left" in str(found)
    T, P, truth = (np.array(x) for x in logged(true))
    T[:9, 4:], P[:9, 4:] = np.nan, np.nan
    assert jaxslam.evaluate_poses(T, P, truth).suggested == true
    one = jaxslam.evaluate_poses(*logged(Convention("left"), runs=1, steps=50))
    assert one.suggested is None
    assert "1 run of 50 steps" in str(one)


def test_nothing_is_said_where_conventions_cannot_be_told():
    T, _, _ = logged(Convention(), spread=0.0)
    P = np.broadcast_to(1e-4 * np.eye(6), (*T.shape[:2], 6, 6))
    noise = 1e-2 * np.random.default_rng(0).normal(size=(*T.shape[:2], 6))
    found = jaxslam.evaluate_poses(T, P, benchmark.displaced(T, noise, Convention()))
    assert found.identified is not None
    assert found.identified.convention is None
    assert set(found.identified.consistent) == set(alternatives(Convention(), SPATIAL))
    assert "cannot be distinguished from" in str(found)
    assert "; and 10 more" in str(found)


def test_the_checker_asks_for_differences_beyond_scatter_and_of_some_size():
    rng = np.random.default_rng(0)
    nees = rng.chisquare(6, size=(50, 10))
    a, b, c = (Convention(error) for error in ("right", "left", "split"))

    def found(stated, **nees):
        names = {"a": a, "b": b, "c": c}
        return identify(stated, {names[name]: Tried(x, 6) for name, x in nees.items()})

    assert found(a, a=nees, b=1.03 * nees).convention is None
    assert found(b, a=nees, b=1.2 * nees).convention == a
    noisy = nees + rng.normal(0.5, 20, size=(50, 10))
    assert found(a, a=nees, c=noisy).consistent == (a, c)


def along_one_path(runs, factor, geometry, seed):
    """Runs of one path, some metres from the origin, each with one left error all along it."""
    T, n = some(geometry, (1, 12), seed) + 0.0, geometry.point_dim
    T[..., :n, n] += 9.0
    T, sigma = np.repeat(T, runs, axis=0), np.repeat([0.07, 0.02], [n, geometry.tangent_dim - n])
    errors = factor * sigma * np.random.default_rng(seed).normal(size=(runs, 1, len(sigma)))
    P = np.broadcast_to(np.diag(sigma**2), (runs, 12, len(sigma), len(sigma)))
    truth = benchmark.displaced(T, np.repeat(errors, 12, axis=1), Convention("left"))
    return T, P, truth


@pytest.mark.parametrize(
    ("runs", "factor", "geometry"),
    [(16, 1, PLANAR), (8, 1, PLANAR), (6, 1, SPATIAL), (16, 4, PLANAR)],
)
def test_of_few_runs_along_one_path_the_convention_is_found(runs, factor, geometry):
    """Their wrong NEES scatters as the square of one number a run, and is far larger all the same;
    also where runs are fewer, or σ is wrong with every convention."""
    for seed in (1, 2, 4) if runs < 16 else (0, 1):
        case = along_one_path(runs, factor, geometry, seed)
        for stated, wrong in ((Convention("right"), True), (Convention("left"), False)):
            found = jaxslam.evaluate_poses(*case, stated).identified
            assert found, seed
            assert (found.doubtful or found.better is not None) == wrong, seed
            told = "doubtful" if factor == 1 else "fits better than"
            assert (told in found.sentence) == wrong
    T, P, truth = along_one_path(2, 0.0, geometry, 0)  # without errors nothing is told
    assert not jaxslam.evaluate_poses(T, P, truth, Convention("left")).suggested


def test_a_covariance_given_the_scale_is_found_where_the_truth_has_another():
    T, P, truth = logged(Convention("split", "body"))
    truth = truth.copy()
    truth[..., :3, 3] *= 1.7
    found = jaxslam.evaluate_poses(T, P, truth, Convention("split", "body"))
    assert found.suggested == Convention("split", "body", scale="given")
    given = jaxslam.evaluate_poses(T, P, truth, found.suggested)
    assert (given.dof, given.scale is not None) == (6, True)
    fits = given.scale.axis_fitted if given.scale else ()
    # The scale of small displacements is not affine, nor are errors exactly Gaussian.
    assert not_disproved(given.verdict)
    assert "NEES is computed at the scale of each run" in str(given)
    for axis in range(6):
        z, fitted = given.errors[..., [axis]] / given.sigmas[..., [axis]], fits[axis]
        assert given.axis_verdict(axis) == run_verdict(z[..., 0] ** 2, 1, fitted, whitened=z)


def test_where_sigma_is_wrong_no_convention_is_blamed():
    """A scale of each pose's own took a third of the position's NEES, and made up for its σ."""
    for number, factors in enumerate(((1.25, 0.8), (1.08, 1.08), (0.7, 0.7))):
        case = benchmark.with_factors(number, 60, *factors)
        found = jaxslam.evaluate_poses(*case[1:4], case.stated)
        assert found.identified is not None
        assert not found.identified.doubtful
        assert factors != (0.7, 0.7) or found.identified.consistent == ()
    assert "no other convention" in str(found)


def test_a_convention_beside_which_the_stated_one_stands_is_not_the_only_one():
    nees = np.random.default_rng(0).chisquare(6, size=(20, 10))
    tried = {Convention(): Tried(nees, 6), Convention("left"): Tried(1.06 * nees, 6)}
    found = identify(Convention("left"), tried)
    assert found.suggested == Convention()
    assert found.stands
    assert "fits the same runs better, NEES" in found.sentence
    assert "only" not in found.sentence
    # Nor is one of right and split, which are the same to first order.
    told = str(jaxslam.evaluate_poses(*logged(Convention("right", "body"), spread=0.3)))
    assert "right and split errors are the same to first order" in told
    assert "the only one" not in told


# --- axes that are not estimated ----------------------------------------------------------------


@pytest.mark.parametrize(("other", "vertical"), [(0.0, 1), (1e6, 2)])
def test_axes_that_are_not_estimated_have_no_degree_of_freedom(other, vertical):
    for factor, right in ((1.0, True), (0.6, False)):
        *poses, nees = planar(factor=factor, other=other, vertical=vertical)
        found = jaxslam.evaluate_poses(*poses, SPLIT)
        assert found.names == (("x", "y", "rz") if vertical == 2 else ("x", "z", "ry"))
        assert found.dof == 3
        np.testing.assert_allclose(found.nees, nees, rtol=1e-6)
        assert not_disproved(found.verdict) == right
        assert "not estimated, as errors are zero" in str(found)
        assert found.identified is not None
        assert not found.identified.doubtful
        assert not any(c.axes == "mixed" for c in found.identified.nees)


def test_a_wrong_convention_of_a_planar_robot_is_found_too():
    *poses, _ = planar()
    for stated in (Convention("split", "world", "rotation-first"), Convention("split", "body")):
        assert jaxslam.evaluate_poses(*poses, stated).suggested == SPLIT


def test_of_the_axes_used_alone_a_folder_is_evaluated_and_drawn(tmp_path):
    *poses, _ = planar(runs=3)
    write_runs(tmp_path, *poses, SPLIT)
    found = jaxslam.evaluate_log(tmp_path, axes_used="rz,x")
    assert found.names == ("x", "rz")
    axes = new_figure(4, 3).subplots()
    labels = [plot_axis(found, axis, ax=axes).get_ylabel() for axis in (0, 1)]
    assert labels == ["m", "rad"]


def test_an_axis_whose_variance_is_always_zero_is_not_estimated():
    """The height of a truth is that of a body above the plane, which the filter does not know."""
    T, P, truth, nees = planar(other=0.0)
    truth = truth.copy()
    truth[..., 2, 3] += 0.05
    found = jaxslam.evaluate_poses(T, P, truth, SPLIT)
    assert found.names == ("x", "y", "rz")
    np.testing.assert_allclose(found.nees, nees, rtol=1e-6)
    assert "or σ is zero; left out, as with --axes-used x,y,rz" in str(found)


@pytest.mark.parametrize(("correlation", "left_out"), [(0.0, True), (0.3, False)])
def test_an_axis_of_small_errors_is_estimated_where_it_is_correlated(correlation, left_out):
    """Heights that are off by a millionth of their σ; with a correlation, they are told by x."""
    T, P, truth, _ = planar(other=1.0)
    T, P = T.copy(), P.copy()
    T[..., 2, 3] += 1e-6 * np.random.default_rng(1).normal(size=T.shape[:2])
    P[..., 0, 2] = P[..., 2, 0] = correlation * np.sqrt(P[..., 0, 0] * P[..., 2, 2])
    found = jaxslam.evaluate_poses(T, P, truth, SPLIT)
    assert ("z" not in found.names) == left_out
    assert "not estimated, as errors are zero" in str(found)


# --- one scale a run ----------------------------------------------------------------------------

DRIFT = benchmark.ScaleDrift(runs=30, steps=40)


@pytest.mark.parametrize("kind", benchmark.RIGHT)
def test_a_right_filter_is_consistent_at_one_scale_however_its_errors_are_common(kind):
    word, named = benchmark.judged_drift(kind, 0.0, DRIFT, 0)
    assert word in ("consistent", "cannot tell")
    assert not named


def test_a_drift_of_scale_is_over_confident_and_named():
    """Each pose at a scale of its own had hidden it, be it fourfold."""
    assert benchmark.judged_drift("drift", 0.05, DRIFT, 0) == ("over-confident", True)
    arrays = benchmark.drifting("drift", float(np.log(4)), DRIFT, 0)
    found = jaxslam.evaluate_poses(*arrays, benchmark.SPLIT, align="sim3")
    assert "the scale drifts by" in found.headline
    assert "times its σ: over-confident" in found.headline
    scale = found.asdict()["scale"]
    assert scale["disproved"]
    assert len(scale["log_scale"]) == 30
    drift = np.array(scale["drift"])
    # Of log s, from the first poses that tell it to the last one; relative to the run's.
    assert drift[-2] - drift[2] == pytest.approx(np.log(4) * 35 / 39, rel=0.05)
    panels = [axes.get_title() for axes in plot_evaluation(found).axes]
    assert sum(title.startswith("scale") for title in panels) == 1
    assert found.scale is not None
    steady = replace(found.scale, drift=0.001 * found.scale.drift)
    axes = plot_scale(replace(found, scale=steady), ax=new_figure(4, 3).subplots())
    low, high = axes.get_ylim()  # what is claimed is shown where no scale drifts
    assert plot_axis(found, 0, ax=new_figure(4, 3).subplots()).get_ylabel() == "map units"
    claimed = np.array([line.get_ydata() for line in axes.lines[-2:]])
    sigma = np.nanmedian(found.scale.sigma[:, -1])
    np.testing.assert_allclose(claimed[:, -1], 100 * np.expm1([-2 * sigma, 2 * sigma]))
    assert low < -np.nanmedian(abs(claimed), axis=1).max()
    assert np.nanmedian(abs(claimed), axis=1).max() < high


@pytest.mark.parametrize(("factor", "disproved"), [(0.3, False), (3.0, True)])
def test_a_drift_smaller_than_its_sigma_is_no_fault(factor, disproved):
    """The verdict knows that σ is wrong both times; only a drift beyond it is named."""
    drift = factor * np.random.default_rng(0).normal(size=(50, 10))
    found = Scale(np.zeros(50), drift, np.ones_like(drift), drift**2, 0.0)
    assert found.verdict is not None
    assert found.verdict["p"] < 1e-6
    assert found.disproved == disproved
    assert ("over-confident" in found.sentence) == disproved


def test_the_size_of_a_drift_is_that_of_the_poses_that_tell_it():
    """A pose of σ = 1 tells a hundredth of what one of σ = 0.1 does, and one of σ = 0 has no size
    that may be compared."""
    drift, sigma = np.array([[0.2, 1.0, np.nan, 0.3]]), np.array([[0.1, 1.0, np.inf, 0.0]])
    nees = np.array([[4.0, 1.0, np.nan, np.inf]])
    found = Scale(np.zeros(1), drift, sigma, nees, 1.0)
    assert found.rms == pytest.approx(np.sqrt((100 * 0.2**2 + 1) / 101), rel=1e-12)


def jointly(joint, convention, runs, steps):
    """Paths, joint covariances, and truths whose errors along a whole run are drawn from them."""
    T = np.tile(some(SPATIAL, (1, steps), 3, 2.0), (runs, 1, 1, 1))
    noise = np.random.default_rng(5).normal(size=(runs, 6 * steps)) @ np.linalg.cholesky(joint).T
    truth = benchmark.displaced(T, noise.reshape(runs, steps, 6), convention)
    return T, np.broadcast_to(joint, (runs, *joint.shape)), truth


def test_with_the_joint_covariance_the_scale_is_the_exact_one():
    """Errors with most of them common: each NEES has all of its degrees of freedom, and the drift
    its one; the least sum over s is found."""
    convention, steps = Convention("split", "world", scale="given"), 5
    root = np.random.default_rng(1).normal(size=(6 * steps, 6 * steps))
    joint = 1e-6 * (root @ root.T + np.eye(6 * steps))
    T, joints, truth = jointly(joint, convention, 300, steps)
    truth[..., :3, 3] *= 1.7
    found = jaxslam.evaluate_poses(T, joints, truth, convention)
    assert (found.dof, found.fitted) == (6, 0.0)
    assert found.scale is not None
    for step in range(steps):
        assert consistent(found.nees[:, step], 6)
        assert consistent(found.scale.nees[:, step], 1)
    s = np.exp(found.scale.log_scale[0])
    assert s == pytest.approx(1 / 1.7, rel=0.02)

    def whole(s):
        scaled = truth[0].copy()
        scaled[:, :3, 3] *= s
        e = pose_errors(convention, T[0], scaled).ravel()
        return e @ np.linalg.solve(joint, e)

    assert whole(s) < min(whole(s * 0.9999), whole(s * 1.0001))


# --- alignment ----------------------------------------------------------------------------------

MOTION = Similarity(Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix(), np.array([5.0, -3, 1]), 1.0)


def moved_covariances(motion, P, T, convention):
    """Covariances of errors of the poses T in another world."""
    own = motion.block @ converted(P, T, convention, SPLIT) @ motion.block.T
    return converted(own, motion.moved(T), SPLIT, convention)


def elsewhere(T, P, convention, motion):
    """The estimate in another world, with its covariance there."""
    shape = T.shape
    flat, flat_P = T.reshape(-1, 4, 4), P.reshape(-1, 6, 6)
    moved = moved_covariances(motion, flat_P, flat, convention)
    return motion.moved(flat).reshape(shape), moved.reshape(P.shape)


@pytest.mark.parametrize(
    ("convention", "align"), [(Convention("left"), "sim3"), (Convention("right", "world"), "se3")]
)
def test_alignment_by_all_positions_undoes_a_motion_of_the_world(convention, align):
    T, P, truth = logged(convention, spread=2.0)
    motion = MOTION._replace(scale=1.0 if align == "se3" else 0.3)
    moved = elsewhere(T, P, convention, motion)
    here = jaxslam.evaluate_poses(T, P, truth, convention, align=align)
    there = jaxslam.evaluate_poses(*moved, truth, convention, align=align)
    for name in ("nees", "rmse", "sigma"):
        np.testing.assert_allclose(getattr(there, name), getattr(here, name), rtol=1e-6)
    if here.scale and there.scale:
        np.testing.assert_allclose(there.scale.nees, here.scale.nees, rtol=1e-6)
    joint = np.stack([diagonal(run) for run in P])
    whole = jaxslam.evaluate_poses(T, joint, truth, convention, align=align)
    np.testing.assert_allclose(whole.nees, here.nees, rtol=1e-4)


def test_a_moved_covariance_is_that_of_moved_errors():
    """Drawn errors, moved as poses are: their covariance is the one that was transported."""
    convention, motion = Convention("left", "body", "rotation-first"), MOTION._replace(scale=2.5)
    T = np.tile(some(SPATIAL, (1,)), (1, 40_000, 1, 1))
    P = 1e-4 * covariance(6)
    noise = np.random.default_rng(0).normal(size=(1, 40_000, 6)) @ np.linalg.cholesky(P).T
    truth = benchmark.displaced(T, noise, convention)
    errors = pose_errors(convention, motion.moved(T), motion.moved(truth))[0]
    expected = moved_covariances(motion, P[None], T[0, :1], convention)[0]
    both = np.outer(sigma := np.sqrt(np.diag(expected)), sigma)
    # Of 40 000 draws the correlations scatter by .005.
    np.testing.assert_allclose(np.cov(errors.T) / both, expected / both, atol=0.03)


def test_the_oblique_projection_is_what_alignment_does_to_errors():
    """A joint covariance with most of its errors common to all poses, as a SLAM's: the NEES of
    aligned poses is χ² with the projected covariance, and far too small with the first one."""
    steps, runs = 6, 40
    U = gauge_directions(some(SPATIAL, (1, steps), 3, 2.0)[0], "sim3").reshape(6 * steps, -1)
    own = np.kron(np.eye(steps), 1e-6 * np.diag([1, 4, 9, 1, 2, 3]))
    joint = own + 1e-4 * U @ U.T
    T, joints, truth = jointly(joint, SPLIT, runs, steps)
    found = jaxslam.evaluate_poses(T, joints, truth, SPLIT, align="sim3")
    for step in range(steps):
        assert consistent(found.nees[:, step], 6)
    assert "joint covariance is projected" in str(found)
    assert (found.sigmas[0] ** 2).mean() < 0.1 * np.diag(joint).mean()


@pytest.mark.parametrize("align", ["first", "se3"])
def test_by_an_alignment_no_right_filter_whose_errors_correlate_seems_wrong(align):
    """Errors that stay the same all along a run, where the alignment takes them as independent."""
    T, P, _ = logged(SPLIT, runs=12, steps=8)
    errors = np.random.default_rng(1).normal(size=(12, 1, 6)) @ np.linalg.cholesky(P[0, 0]).T
    for factor, word in ((1.0, "cannot tell"), (20.0, "over-confident")):
        truth = benchmark.displaced(T, np.tile(factor * errors, (8, 1)), SPLIT)
        found = jaxslam.evaluate_poses(T, P, truth, SPLIT, align=align)
        assert found.verdict["word"] == word
        assert any("if errors of different poses correlate" in note for note in found.notes)


def diagonal(blocks):
    """A matrix of blocks (k, n, n) on its diagonal."""
    count, n = blocks.shape[:2]
    return np.einsum("kij,kl->kilj", blocks, np.eye(count)).reshape(count * n, count * n)


def test_an_estimate_that_begins_at_a_known_pose_is_aligned_there():
    convention = Convention("left")
    T, P, truth = logged(convention)
    P, truth = P.copy(), truth.copy()
    P[:, 0], truth[:, 0] = 0, T[:, 0]
    here = jaxslam.evaluate_poses(T, P, truth, convention)
    moved = elsewhere(T, P, convention, MOTION)
    there = jaxslam.evaluate_poses(*moved, truth, convention, align="se3")
    assert there.steps == 5
    np.testing.assert_allclose(there.nees, here.nees, rtol=1e-6)
    assert "aligned at the first pose" in str(there)
    assert consistent(there.nees, 6)
    larger = elsewhere(T, P, convention, MOTION._replace(scale=3.0))
    free = jaxslam.evaluate_poses(*larger, truth, convention, align="sim3")
    assert free.dof == 6
    assert (free.nees.sum(axis=1) <= there.nees.sum(axis=1) * (1 + 1e-6)).all()
    assert not_disproved(free.verdict)


def test_the_rotation_about_a_straight_line_is_not_fitted_to_noise():
    """Ten metres straight on, each pose with an error of 5 cm and .01 rad, of its own."""
    runs, steps, sigma = 40, 6, np.repeat([0.05, 0.01], 3)
    noise = sigma * np.random.default_rng(0).normal(size=(runs, steps, 6))
    turn = Rotation.from_rotvec(noise[..., 3:].reshape(-1, 3)).as_matrix()
    P = np.broadcast_to(np.diag(sigma**2), (runs, steps, 6, 6))
    for straight in (True, False):
        truth = np.tile(np.eye(4), (runs, steps, 1, 1))
        truth[..., 0, 3] = along = np.linspace(0, 10, steps)
        truth[..., 1, 3] = 0 if straight else np.sin(along)
        T = truth.copy()
        T[..., :3, 3] += noise[..., :3]
        T[..., :3, :3] = turn.reshape(runs, steps, 3, 3)
        moved = elsewhere(T, P, SPLIT, MOTION)
        found = jaxslam.evaluate_poses(*moved, truth, SPLIT, align="sim3")
        assert not_disproved(found.verdict)
        assert ("straight line" in str(found)) == straight


def test_pairs_and_fits_are_those_of_evo():
    core = pytest.importorskip("evo.core.geometry")
    sync = pytest.importorskip("evo.core.sync")
    trajectory = pytest.importorskip("evo.core.trajectory")
    rng = np.random.default_rng(0)

    def evos(times):
        still = np.tile([1.0, 0, 0, 0], (len(times), 1))
        return trajectory.PoseTrajectory3D(np.zeros((len(times), 3)), still, times)

    for _ in range(8):
        a, b = (np.sort(rng.uniform(0, 0.1, size)) for size in rng.integers(3, 40, size=2))
        ours, theirs = associated(a, b)
        first, second = sync.associate_trajectories(evos(a), evos(b), max_diff=0.01)
        np.testing.assert_array_equal(a[ours], first.timestamps)
        np.testing.assert_array_equal(b[theirs], second.timestamps)
    x, y = rng.normal(size=(2, 10, 3))
    for scaled in (False, True):
        found, wanted = similarity(x, y, scaled=scaled), core.umeyama_alignment(x.T, y.T, scaled)
        for ours, theirs in zip(found, wanted, strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-9)


@pytest.mark.parametrize(("align", "joint"), [("se3", True), ("sim3", False)])
def test_poses_that_were_not_logged_change_nothing_of_the_others(align, joint):
    """A run that is padded, and one with a gap in its truth, are the runs without those steps."""
    T, P, truth = (np.array(x) for x in logged(Convention("left"), runs=3, steps=8))
    T[1, 5:, :3], P[1, 5:], truth[2, 3] = np.nan, np.nan, np.nan

    def evaluated(T, P, truth):
        whole = np.stack([diagonal(run) for run in P]) if joint else P
        return jaxslam.evaluate_poses(T, whole, truth, Convention("left"), align=align)

    found = evaluated(T, P, truth)
    for run, steps in enumerate([np.arange(8), np.arange(5), np.delete(np.arange(8), 3)]):
        alone = evaluated(*(x[run : run + 1, steps] for x in (T, P, truth)))
        np.testing.assert_allclose(found.nees[run, steps], alone.nees[0], rtol=1e-9)
        np.testing.assert_allclose(found.errors[run, steps], alone.errors[0], atol=1e-12)
        np.testing.assert_allclose(found.sigmas[run, steps], alone.sigmas[0], rtol=1e-9)
        assert found.logged[run].sum() == len(steps)
    assert "4 of 24 steps are not compared (run 1: 3, run 2: 1)" in str(found)
    json.dumps(found.asdict(), allow_nan=False)


# --- text and folders; that each format is its arrays is a law of logs ----------------------------


def test_a_covariance_file_by_others_may_be_in_degrees_and_say_little(tmp_path):
    path, P = tmp_path / "c.txt", covariance(6)
    upper = " ".join(str(x) for x in P[np.triu_indices(6)])
    path.write_text(f"# made by my filter\n# angle=deg order=rotation-first\n\n0, {upper}\n")
    found = read_covariances(path)
    unit = np.repeat([np.pi / 180, 1.0], 3)
    np.testing.assert_allclose(found.covariances[0], P * unit * unit[:, None], rtol=1e-12)
    assert found.convention == Convention(order="rotation-first")
    path.write_text(f"0 {upper}\n")
    assert read_covariances(path).convention == Convention()


def test_runs_in_folders_are_compared_as_far_as_each_goes_and_named_where_they_are_lost(tmp_path):
    """In the convention that files say, unless another one is stated."""
    convention = Convention("split", "mixed", "rotation-first")
    T, P, truth = (np.array(x) for x in logged(convention, runs=3))
    truth[0, 3:, :3, 3] += 50.0
    write_runs(tmp_path, T, P, truth, convention)
    times = np.arange(6) / 10
    write_tum(tmp_path / "run01" / "truth.txt", times[:4], truth[1, :4])
    write_tum(tmp_path / "run02" / "estimate.txt", times[:5], T[2, :5])
    found = jaxslam.evaluate_log(tmp_path)
    arrays = jaxslam.evaluate_poses(T, P, truth, convention)
    assert found.steps == 6
    there = np.ones((3, 6), bool)
    there[1, 4:], there[2, 5:] = False, False
    np.testing.assert_array_equal(found.logged, there)
    np.testing.assert_allclose(found.nees[there], arrays.nees[there], rtol=1e-4)
    told, written = str(found), found.asdict()
    assert "3 of 18 steps are not compared (run01: 2, run02: 1)" in told
    assert "2 of 17 poses have no truth, and are left out" in told
    assert "1 of 18 covariances are at no time of the estimate" in told
    assert "runs have 5 to 6 poses" in told
    assert written["lost_runs"] == ["run00"]
    assert written["run_names"] == ["run00", "run01", "run02"]
    assert written["convention"] == {
        "error": "split", "axes": "mixed", "order": "rotation-first", "scale": "marginal",
    }  # fmt: skip
    assert written["time"] == pytest.approx(times)
    assert list(written["rmse"]) == ["rx", "ry", "rz", "x", "y", "z"]
    stated = {"error": "left", "order": "position-first"}
    assert jaxslam.evaluate_log(tmp_path, stated=stated).convention == Convention("left", "world")
    assert "steps are counted" not in told
    slower = np.arange(6) / 5
    write_tum(tmp_path / "run01" / "estimate.txt", slower, T[1])
    write_covariances(tmp_path / "run01" / "covariance.txt", slower, P[1], convention)
    write_tum(tmp_path / "run01" / "truth.txt", slower, truth[1])
    told = str(jaxslam.evaluate_log(tmp_path))
    assert "their times differ between runs, and are those of run00" in told


# --- the tracker's files --------------------------------------------------------------------------


def test_of_the_trackers_files_nees_is_given_the_scale(tmp_path):
    trajectory = pytest.importorskip("jaxslam.tracking.trajectory")
    given = replace(trajectory.TRACKED, scale="given")
    T, P, truth = logged(trajectory.TRACKED, runs=1, steps=100)
    T, P, truth = T[0], P[0].copy(), truth[0].copy()
    P[0], truth[0] = 0, T[0]
    times = np.arange(100) / 30
    write_tum(tmp_path / "trajectory.txt", times, T)
    write_covariances(tmp_path / "covariance.txt", times, P, given)
    write_tum(tmp_path / "groundtruth.txt", times, truth)
    found = jaxslam.evaluate_log(tmp_path)
    assert found.convention == given
    assert (found.dof, found.steps, found.fitted) == (6, 99, 1.0)
    best = errors_beyond_scale(trajectory.TRACKED, T[1:], truth[1:], P[1:])
    nees = one_scale(*(np.asarray(x) for x in best)).nees
    np.testing.assert_allclose(found.nees[0], nees, rtol=1e-4)
    assert Tally.of(found.nees, 6, 1.0).average.mean == pytest.approx(found.verdict["nees"])


def test_frames_that_the_tracker_says_nothing_of_the_unit_of_are_left_out(tmp_path):
    first = [("start", 0, 1.5), *9 * [UNFIXED], *60 * [FIXED], *5 * [LOST]]
    second = [("start", 0, 7.0), *20 * [("tracked", 1, 7.0)]]
    arrays = tracked_run(tmp_path, [first, second])
    found = jaxslam.evaluate_log(tmp_path, align="sim3")
    own = [0, *range(10, 70)]
    expected = jaxslam.evaluate_poses(*(x[:, own] for x in arrays), TRACKED, align="sim3")
    np.testing.assert_allclose(found.nees[0, :60], expected.nees[0], rtol=1e-4)
    assert found.logged.sum() == 60
    assert found.alignment == "sim3"
    for said in (
        "aligned at the first pose",
        "map 0, the longest, is evaluated",
        "21 of 96 poses are of other maps",
        "5 of 96 poses are of frames that are lost",
        "9 of 96 poses are from before the unit of their map was fixed",
    ):
        assert said in str(found)
    late = jaxslam.evaluate_log(tmp_path, align="sim3", time_offset=1 / 30)
    assert late.logged.sum() == 60  # its frames are found by their own stamps
    (tmp_path / "frames.csv").unlink()
    assert jaxslam.evaluate_log(tmp_path, align="sim3").verdict["nees"] > 10 * found.verdict["nees"]


def test_a_later_map_that_is_the_longest_is_evaluated_in_its_own_unit(tmp_path):
    first = [("start", 1, 1.0), *10 * [FIXED]]
    arrays = tracked_run(tmp_path, [first, 40 * [("tracked", 1, 7.0)]])
    found = jaxslam.evaluate_log(tmp_path, align="sim3")
    expected = jaxslam.evaluate_poses(*(x[:, 11:] for x in arrays), TRACKED, align="sim3")
    np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-4)
    assert "map 1, the longest, is evaluated" in str(found)
    assert "11 of 51 poses are of other maps" in str(found)
    with pytest.raises(ValueError, match=r"map is map 1, .*; use --align sim3"):
        jaxslam.evaluate_log(tmp_path)


@pytest.mark.parametrize("text", ["frame,time,state,map\n0,0,lost,0\n", "\0\udcff,\n" * 9])
def test_files_of_that_name_by_others_and_of_older_versions_say_nothing(text, tmp_path):
    tracked_run(tmp_path, [20 * [FIXED]])
    (tmp_path / "frames.csv").write_bytes(text.encode(errors="surrogateescape"))
    assert jaxslam.evaluate_log(tmp_path).logged.all()


# --- a truth that is measured -------------------------------------------------------------------


def measured(truth, sigma):
    """True poses as an instrument sees them, of that σ (m, degrees) along the axes of the body."""
    each = np.repeat([sigma[0], np.radians(sigma[1])], 3)
    noise = each * np.random.default_rng(9).normal(size=(*truth.shape[:2], 6))
    return benchmark.displaced(truth, noise, Convention())


def test_a_right_filter_is_consistent_with_the_sigma_of_a_measured_truth():
    sigma, convention = (0.02, 1.5), Convention("left", "body")
    T, P, truth = logged(convention)
    seen = measured(truth, sigma)
    exact = jaxslam.evaluate_poses(T, P, seen, convention)
    assert exact.verdict["word"] == "over-confident"
    assert exact.asdict()["truth_sigma"] is None
    found = jaxslam.evaluate_poses(T, P, seen, convention, truth_sigma=sigma)
    assert consistent(found.nees, 6)
    assert found.asdict()["truth_sigma"] == [0.02, 1.5]
    assert "every stated σ includes that of the truth, 0.02 m and 1.5°" in found.notes


@pytest.mark.parametrize(
    ("convention", "geometry"),
    [(EVERY[0], SPATIAL), (EVERY[11], SPATIAL), (EVERY[21], SPATIAL), (EVERY[11], PLANAR)],
)
def test_derivatives_by_true_poses_are_those_of_the_error(convention, geometry):
    """Of errors that are not small: by the truth, and by the pose on which the estimate is laid."""
    t, h = geometry.tangent_dim, 1e-6
    T, truth, first = (some(geometry, (3,), seed, 0.5) for seed in (0, 1, 2))
    axes = {"right": "body", "left": "world", "split": "mixed"}[convention.error]
    fixed = Convention(convention.error, axes, convention.order)  # does not turn with the estimate
    J, M = truth_derivatives(fixed, T, truth, first)

    def moved(poses, axis, step):
        return benchmark.displaced(poses, step * np.tile(np.eye(t)[axis], (3, 1)), Convention())

    def by_truth(axis, step):
        return pose_errors(fixed, T, moved(truth, axis, step))

    def by_first(axis, step):
        return pose_errors(fixed, moved(first, axis, step) @ np.linalg.inv(first) @ T, truth)

    for axis in range(t):
        for D, error in ((J, by_truth), (M, by_first)):
            central = (error(axis, h) - error(axis, -h)) / (2 * h)
            np.testing.assert_allclose(D[..., axis], central, atol=1e-7)
    turned = truth_derivatives(convention, T, truth, first)
    N = change(T, fixed, convention)
    np.testing.assert_allclose(turned[0], N @ J, atol=1e-12)


@pytest.mark.slow
def test_the_noise_of_a_first_true_pose_moves_all_and_metres_are_the_truths():
    """A camera in a unit of its own, 4 m, laid on the first pose of a truth that is measured; no
    quick test has both."""
    sigma, (T, P, truth) = (0.08, 1.0), logged(TRACKED, runs=80, steps=12, spread=0.5)
    P = P.copy()
    P[:, 0], truth[:, 0] = 0, T[:, 0]
    truth = Similarity(Rotation.from_rotvec([0.3, 1, 0]).as_matrix(), np.ones(3), 4.0).moved(truth)
    seen = measured(truth, sigma)
    exact = jaxslam.evaluate_poses(T, P, seen, TRACKED, align="sim3")
    assert exact.verdict["word"] == "over-confident"
    found = jaxslam.evaluate_poses(T, P, seen, TRACKED, align="sim3", truth_sigma=sigma)
    assert 4.9 < found.nees.mean() < 6.1
    assert found.verdict["word"] != "over-confident"


def test_with_a_joint_covariance_the_first_true_poses_noise_is_common():
    T, P, truth = logged(Convention(), runs=2, steps=3)
    joint = np.stack([diagonal(one) for one in P])
    poses, firsts = checked_poses(T, joint, truth, Convention()), truth[:, 0]
    found = with_truth(poses._replace(truth_sigma=(0.1, 2.0)), np.ones(2), firsts)
    assert found.joint is not None
    blocks = found.joint.reshape(2, 3, 6, 3, 6)
    for k in range(3):
        np.testing.assert_allclose(blocks[:, k, :, k], found.covariances[:, k], rtol=1e-9)
    M = truth_derivatives(Convention(), T, truth, np.repeat(firsts[:, None], 3, axis=1))[1]
    S = np.diag([0.1**2] * 3 + [np.radians(2.0) ** 2] * 3)
    common = M[:, 1] @ S @ np.swapaxes(M[:, 2], 1, 2)
    np.testing.assert_allclose(blocks[:, 1, :, 2], common, rtol=1e-9, atol=1e-15)
    assert joint[0, 0, 0] == P[0, 0, 0, 0]


def test_the_first_covariance_is_added_to_the_others_where_they_are_joint_too():
    T, P, true = logged(SPLIT, runs=3, steps=5)
    one, other = (
        jaxslam.evaluate_poses(T, given, true, SPLIT, align="first")
        for given in (P, np.stack([diagonal(run) for run in P]))
    )
    np.testing.assert_allclose(one.mean, other.mean)
