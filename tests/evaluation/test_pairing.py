"""Which true pose and which covariance belong to an estimate, and what has a degree of freedom."""

import re

import numpy as np
import pytest
from log_faults import flight
from logs import logged, planar
from scipy import stats
from scipy.spatial.transform import Rotation

import jaxslam
from jaxslam.evaluation import Convention, evaluate_log, evaluate_nees, evaluate_poses
from jaxslam.evaluation.convention import write_covariances
from jaxslam.io.logs import read_log
from jaxslam.io.tum import quaternions, write_tum

LOG = flight(np.random.default_rng(4), 1, 30)
WANTED = evaluate_poses(LOG.estimates, LOG.covariances, LOG.truths, LOG.convention).nees


def files(folder, true=slice(None), own=slice(None), late=0.0):
    """One run, of these of its hundred true poses a second and of its ten estimates."""
    times = LOG.times[own]
    write_tum(folder / "estimate.txt", times, LOG.estimates[0, own])
    write_covariances(folder / "covariance.txt", times, LOG.covariances[0, own], LOG.convention)
    write_tum(folder / "truth.txt", LOG.dense_times[true] + late, LOG.dense[0, true])
    return folder


@pytest.mark.parametrize("unit", [1.0, 180 / np.pi])
@pytest.mark.parametrize("order", [[0, 1, 2, 5, 4, 3], [5, 4, 3, 0, 1, 2], [0, 1, 2, 3, 4, 5],
                                   [3, 4, 5, 0, 1, 2]])  # fmt: skip
def test_which_columns_are_places_and_which_is_the_yaw_is_told_by_the_course(order, unit, tmp_path):
    angles = unit * Rotation.from_matrix(LOG.dense[0, :, :3, :3]).as_euler("ZYX")
    rows = np.column_stack([LOG.dense[0, :, :3, 3], angles])[:, order]
    np.savetxt(tmp_path / "log.txt", np.column_stack([LOG.dense_times, rows]))
    np.testing.assert_allclose(read_log(tmp_path / "log.txt").poses, LOG.dense[0], atol=1e-9)


@pytest.mark.parametrize("true", [slice(None), slice(0, None, 3)])
def test_a_truth_at_other_stamps_is_interpolated(true, tmp_path):
    found = evaluate_log(files(tmp_path, true))
    there = found.logged[0]
    assert there.sum() >= 29
    wanted = WANTED[0, 30 - found.steps :]
    np.testing.assert_allclose(found.nees[0, there], wanted[there], rtol=0.02)
    assert any("the truth is interpolated" in note for note in found.notes) == (
        true.step is not None
    )


def test_a_title_says_the_unit_of_times_that_may_be_two(tmp_path):
    """From 0, a hundred a second: microseconds, or milliseconds."""
    files(tmp_path)
    for name, titles in (
        ("estimate", "t_us,x,y,z,qx,qy,qz,qw"), ("truth", "timestamp [us],x,y,z,qx,qy,qz,qw"),
        ("covariance", "t_us" + 21 * " c"),
    ):  # fmt: skip
        rows = np.loadtxt(tmp_path / f"{name}.txt")
        rows[:, 0] *= 1e5
        head = f"# {titles}\n# {LOG.convention}\n"
        cells = "\n".join(",".join(f"{x:.12g}" for x in row) for row in rows)
        (tmp_path / f"{name}.txt").write_text(head + cells + "\n")
    found = evaluate_log(tmp_path)
    there = found.logged[0]
    np.testing.assert_allclose(found.nees[0, there], WANTED[0][-found.steps :][there], rtol=1e-3)


def test_a_truth_that_is_too_rare_to_be_interpolated_is_refused_with_the_reason(tmp_path):
    """At 14 Hz, of an accurate estimate at 10 Hz: few stamps meet."""
    files(tmp_path, slice(0, None, 7))
    P = 1e-3 * LOG.covariances[0]
    write_covariances(tmp_path / "covariance.txt", LOG.times, P, LOG.convention)
    with pytest.raises(ValueError, match="can be compared") as caught:
        evaluate_log(tmp_path)
    told = str(caught.value)
    assert "a pose every 0.07 s, is not interpolated to the estimate's stamps, every 0.1 s" in told
    assert re.search(r"known to [\d.]+ of the estimate's σ only; a denser truth would be", told)


def test_no_truth_is_made_up_across_a_hole_or_beyond_the_ends(tmp_path):
    true = np.r_[5:98, 132:248]
    found = evaluate_log(files(tmp_path, true))
    without = np.flatnonzero(~found.logged[0]) + 1  # of the first is no step
    assert set(without) == {10, 11, 12, 13, 25, 26, 27, 28, 29}
    assert "10 of 30 poses have no truth" in str(found)


def test_where_the_truth_is_rare_its_stamps_are_those_that_are_compared(tmp_path):
    """Twenty true poses, of 300 estimates that are accurate enough to be interpolated."""
    times, dense = LOG.dense_times, LOG.dense[0]
    rows = np.arange(4, 300, 15)
    write_tum(tmp_path / "estimate.txt", times, dense)
    P = np.tile(1e-4 * np.eye(6), (300, 1, 1))
    write_covariances(tmp_path / "covariance.txt", times, P, LOG.convention)
    halfway = (dense[rows, :3, 3] + dense[rows + 1, :3, 3]) / 2
    truth = dense[rows].copy()
    truth[:, :3, 3] = halfway + np.array([0.01, 0.0, 0.0])
    write_tum(tmp_path / "truth.txt", times[rows] + 0.005, truth)
    found = evaluate_log(tmp_path, stated={"error": "split", "axes": "world"}, axes_used="x,y,z")
    assert found.logged.sum() == 20
    np.testing.assert_allclose(found.errors[found.logged], [[0.01, 0.0, 0.0]] * 20, atol=1e-4)
    assert "compared at the stamps of the truth" in str(found)


@pytest.mark.parametrize("value", [-1.0, 1.797e308, np.inf])
def test_axes_of_unknown_variance_have_no_degree_of_freedom(value, tmp_path):
    T, P, truth, nees = planar(runs=1, steps=30)
    times, P = np.arange(30) / 10, P[0].copy()
    P[:, [2, 3, 4], [2, 3, 4]] = value
    write_tum(tmp_path / "estimate.txt", times, T[0])
    write_tum(tmp_path / "truth.txt", times, truth[0])
    rows = np.column_stack([times, P[:, *np.triu_indices(6)]])
    np.savetxt(tmp_path / "covariance.txt", rows, header="error=split axes=world")
    found = evaluate_log(tmp_path)
    assert found.names == ("x", "y", "rz")
    np.testing.assert_allclose(found.nees, nees, rtol=1e-4)
    if value == np.inf:  # of an axis, in every step
        rows[7, 12] = 1.0
        np.savetxt(tmp_path / "covariance.txt", rows, header="error=split axes=world")
        with pytest.raises(ValueError, match=r"holds inf; only finite numbers .inf is of an axis"):
            evaluate_log(tmp_path)


def test_what_a_first_pose_knows_exactly_has_no_degree_of_freedom():
    """Position and yaw; roll and pitch have a σ, and the pose no part in the NEES."""
    split = Convention("split", "world")
    T, P, truth = logged(split, runs=20)
    P, known = P.copy(), [0, 1, 2, 5]
    P[:, 0, known], P[:, 0, :, known] = 0.0, 0.0
    truth[:, 0] = T[:, 0]
    found = evaluate_poses(T, P, truth, split)
    assert "the first step is known exactly, and left out" in found.notes
    np.testing.assert_allclose(
        found.nees, evaluate_poses(T[:, 1:], P[:, 1:], truth[:, 1:], split).nees
    )
    truth[3, 0, 0, 3] += 0.01
    with pytest.raises(ValueError, match="run 3, step 0 has variance 0"):
        evaluate_poses(T, P, truth, split)


def test_degrees_of_freedom_by_step_are_brought_to_one_by_their_probability():
    rng = np.random.default_rng(0)
    dof = rng.integers(1, 9, (20, 30))
    nis = rng.chisquare(dof)
    nis[0, 0], nis[3, 5] = 3e4, np.nan  # beyond all probability, and not logged
    found = evaluate_nees(nis, dof, quantity="NIS")
    one = int(np.median(dof[~np.isnan(nis)]))
    wanted = stats.chi2.isf(stats.chi2.sf(nis, dof), one)
    wanted[0, 0] = 3e4 * one / dof[0, 0]
    assert found.dof == one
    np.testing.assert_allclose(found.nees, wanted, rtol=1e-6)
    assert "degrees of freedom are 1 to 8" in str(found)
    same = evaluate_nees(nis, np.full(nis.shape, 3))
    np.testing.assert_array_equal(same.nees, evaluate_nees(nis, 3).nees)


def test_innovations_of_what_was_not_measured_count_for_nothing():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(20, 30, 3, 3)) + 2 * np.eye(3)
    S, z = root @ np.swapaxes(root, 2, 3), (root @ rng.normal(size=(20, 30, 3, 1)))[..., 0]
    seen = rng.random(z.shape) < 0.7
    seen[..., 0] |= ~seen.any(axis=-1)
    wanted = np.empty((20, 30))
    for place in np.ndindex(20, 30):
        own = np.flatnonzero(seen[place])
        nis = z[place][own] @ np.linalg.solve(S[place][np.ix_(own, own)], z[place][own])
        wanted[place] = stats.chi2.isf(stats.chi2.sf(nis, len(own)), 2)
    without = np.where(seen, z, np.nan), np.where(seen[..., None] & seen[..., None, :], S, np.nan)
    found = jaxslam.evaluate(*without, quantity="NIS")
    assert found.dof == 2
    np.testing.assert_allclose(found.nees, wanted, rtol=1e-6)


def test_covariances_of_rounded_times_are_taken_line_by_line(tmp_path):
    """Ten poses a second, whose covariances are stamped to whole seconds."""
    files(tmp_path)
    write_covariances(
        tmp_path / "covariance.txt", np.floor(LOG.times), LOG.covariances[0], LOG.convention
    )
    found = evaluate_log(tmp_path)
    there = found.logged[0]
    np.testing.assert_allclose(found.nees[0, there], WANTED[0][-found.steps :][there], rtol=0.02)
    assert "times of covariances are rounded to 1 s: they are taken line by line" in found.notes


def test_the_estimate_of_a_folder_has_the_covariances_beside_it(tmp_path):
    """As the folder itself has; a file of another name is none of the run."""
    files(tmp_path)
    estimate, truth = tmp_path / "estimate.txt", tmp_path / "truth.txt"
    found, whole = evaluate_log(estimate, truth=truth), evaluate_log(tmp_path)
    np.testing.assert_array_equal(found.nees, whole.nees)
    other = estimate.rename(tmp_path / "other.txt")
    with pytest.raises(ValueError, match=r"other\.txt has no covariances; give them by --cov"):
        evaluate_log(other, truth=truth)


WITHOUT = 3, 17
"""Lines without a covariance."""


@pytest.mark.parametrize("count", [3, 20, 21])
def test_a_pose_without_a_covariance_in_its_line_is_left_out(count, tmp_path):
    """Three σ of positions by titles, or so many numbers of a covariance: NaN alone."""
    files(tmp_path)
    T, P = LOG.estimates[0], np.diag([4e-4] * 6)
    numbers = {
        3: np.full(3, 0.02),
        20: np.full(12, 0.0) + [4e-4, 0, 0, 4e-4, 0, 4e-4] * 2,
        21: P[*np.triu_indices(6)],
    }[count]
    rows = np.column_stack([LOG.times, T[:, :3, 3], quaternions(T[:, :3, :3])])
    rows = np.column_stack([rows, np.tile(numbers, (len(rows), 1))])
    rows[WITHOUT, 8:] = np.nan
    titles = "t,x,y,z,qx,qy,qz,qw,sx,sy,sz" * (count == 3)
    (tmp_path / "covariance.txt").unlink()
    np.savetxt(tmp_path / "estimate.txt", rows, header=titles, comments="", delimiter=",")
    found = evaluate_log(tmp_path, stated={"error": "split", "axes": "world"})
    assert "2 of 30 poses have no covariance within 0.01 s, and are left out" in found.notes
    assert found.logged.sum() == 28
    assert found.dof == (3 if count == 3 else 6)


def test_a_convention_that_is_stated_is_not_said_to_be_assumed(tmp_path):
    """By titles none is; but by a file of covariances, an option, or a header."""
    files(tmp_path)
    rows = np.column_stack([LOG.times, LOG.estimates[0, :, :3, 3], np.full((30, 3), 0.02)])
    mine = tmp_path / "mine.csv"
    np.savetxt(mine, rows, header="t,x,y,z,sx,sy,sz", comments="", delimiter=",")
    own = tmp_path / "σ.csv"
    np.savetxt(own, rows[:, [0, 4, 5, 6]], header="error=split\nt,sx,sy,sz", delimiter=",")

    def assumed(**how):
        found = evaluate_log(mine, truth=tmp_path / "truth.txt", **how)
        return [x for x in found.notes if "assumed" in x or "taken as" in x]

    assert len(assumed()) == 1
    assert assumed(covariance=tmp_path / "covariance.txt") == []
    assert assumed(covariance=own) == []
    assert assumed(stated={"error": "split"}) == []
