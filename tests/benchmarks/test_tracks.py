"""Tests of recorded tracks: how they are read, and how they share a filter's slots."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tracks import read, window, windows

from jaxslam.models.sensors import Pinhole
from jaxslam.simulation import Room, gone, sightings

SIGHTS = {0: range(0, 4), 1: range(0, 6), 2: range(0, 2), 3: range(1, 6), 4: range(2, 6)}
"""The frames of each track, of a drive of six."""
MOVER = 1


def write(folder, sights=SIGHTS, frames=6):
    """A drive whose track i has the pixel (i, k) in frame k."""
    rows = sorted((k, i) for i, seen in sights.items() for k in seen)
    frame, track = (np.array(column, np.int32) for column in zip(*rows, strict=True))
    times = 0.1 * np.arange(frames) + 0.001 * np.arange(frames) ** 2
    np.savez(
        folder / "tracks.npz",
        frame=frame,
        track=track,
        pixel=np.column_stack([track, frame]).astype(np.float32),
        moving=np.array([i == MOVER for i in sights], np.int8),
        times=times,
        start=0.0,
        intrinsics=np.array([700.0, 710.0, 600.0, 170.0]),
        image_size=np.array([1242, 375]),
    )
    turns = Rotation.from_rotvec(np.outer(np.arange(frames), [0.0, 0.1, 0.0])).as_quat()
    position = np.outer(np.arange(frames), [0.1, 0.0, 1.0])
    np.savetxt(folder / "groundtruth.txt", np.column_stack([times, position, turns]))
    return folder


@pytest.fixture
def drive(tmp_path):
    return read(write(tmp_path))


def held(run):
    """Which track each slot stands for in each frame, by its pixel; −1 for none."""
    return np.where(run.visible, np.asarray(run.measured)[..., 0], -1).astype(int)


def test_who_has_a_slot_keeps_it_and_another_takes_what_is_free(drive):
    run = window(drive, 0, 5, landmarks=2, moving=True)
    # 1 and 3 wait in vain until 0 ends.
    expected = [[0, 2], [0, 2], [0, 4], [0, 4], [1, 4], [1, 4]]
    np.testing.assert_array_equal(held(run), expected)
    new = np.zeros((6, 2), bool)
    new[0] = new[2, 1] = new[4, 0] = True
    np.testing.assert_array_equal(run.new, new)
    left = gone(run, Room(2, 2, 2, 1))
    assert left is not None
    np.testing.assert_array_equal(left, new[1:])
    # In frame k the pixel is that of frame k.
    np.testing.assert_array_equal(run.measured[..., 1], np.arange(6)[:, None] * np.ones(2))


def test_the_tracks_of_a_window_are_spread_over_those_that_begin_together(tmp_path):
    run = window(read(write(tmp_path, {i: range(6) for i in range(60)})), 0, 5, landmarks=12)
    chosen = np.sort(held(run)[0])
    gaps = np.diff(chosen, prepend=-1, append=60)
    assert chosen.size == 12
    assert gaps.max() <= 8, chosen


def test_movers_are_left_out_and_slots_stay_empty(drive):
    run = window(drive, 0, 5, landmarks=3)
    expected = [[0, 2, -1], [0, 2, 3], [0, 4, 3], [0, 4, 3], [-1, 4, 3], [-1, 4, 3]]
    np.testing.assert_array_equal(held(run), expected)
    left = gone(run, Room(3, 2, 3, 2))
    assert left is not None
    # 2 makes room for 4 in frame 2; after 0, in frame 4, nobody comes.
    np.testing.assert_array_equal(np.argwhere(np.asarray(left)), [[1, 1], [3, 0]])
    seen = jax.tree.map(int, sightings(run))
    assert (seen.landmarks, seen.first, seen.known, seen.new) == (3, 2, 3, 1)


def test_a_window_begins_anew_and_its_poses_are_relative(drive):
    run = window(drive, 2, 3, landmarks=2, moving=True)
    np.testing.assert_array_equal(held(run)[0], [0, 4])
    assert run.new is not None
    assert run.new[0].all()
    T = drive.poses
    expected = [np.linalg.inv(T[2]) @ T[k] for k in range(2, 6)]
    np.testing.assert_allclose(run.poses.as_matrix(), expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(run.controls, np.diff(drive.times)[2:])
    assert isinstance(run.sensors, Pinhole)
    intrinsics = np.column_stack([run.sensors.camera.focal, run.sensors.camera.centre])
    np.testing.assert_array_equal(intrinsics, np.tile([700.0, 710.0, 600.0, 170.0], (4, 1)))
    assert np.isnan(run.points).all()
    batch = windows(drive, 3, 3, landmarks=2)
    assert batch.visible.shape == (3, 4, 2)
    np.testing.assert_array_equal(batch.controls[:, 0], np.diff(drive.times)[[0, 1, 2]])


def test_what_holds_no_tracks_or_no_window_is_refused(tmp_path, drive):
    for start, steps, count in ((-1, 3, 2), (3, 3, 2), (0, 0, 2), (0, 3, 0)):
        with pytest.raises(ValueError, match=r"are not in 6 frames"):
            window(drive, start, steps, landmarks=count)
    (tmp_path / "groundtruth.txt").write_text("0 0 0 0 0 0 0 1\n")
    with pytest.raises(ValueError, match="has 1 true poses of 6 frames"):
        read(tmp_path)
    np.savez(tmp_path / "tracks.npz", frame=np.zeros(1))
    with pytest.raises(ValueError, match="lacks track, pixel"):
        read(tmp_path)


def sampson(run, camera, between):
    """Distances of pixels from the epipolar line of some frames before, pixels."""
    T, found = np.asarray(run.poses.as_matrix()), []
    fx, fy, cx, cy = np.asarray(camera.intrinsics)
    K_inv = np.linalg.inv([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    for k in range(between, len(T)):
        seen = np.asarray(run.visible[k] & run.visible[k - between])
        same = seen & ~np.asarray(run.new)[k - between + 1 : k + 1].any(axis=0)
        E = np.linalg.inv(T[k]) @ T[k - between]
        F = K_inv.T @ np.cross(E[:3, 3], E[:3, :3].T).T @ K_inv
        a, b = (
            np.column_stack([np.asarray(run.measured)[i][same], np.ones(same.sum())])
            for i in (k - between, k)
        )
        line, back = a @ F.T, b @ F
        slope = np.sum(line[:, :2] ** 2 + back[:, :2] ** 2, axis=1)
        found.append(np.abs(np.sum(b * line, axis=1)) / np.sqrt(slope))
    return np.concatenate(found)


def test_the_tracks_of_real_drives_agree_with_their_poses(shared_data):
    """Published with them: a median of 0.14 px at one frame, 0.34 at five."""
    data = read(shared_data / "kitti_tracks" / "2011_09_26_0036")
    run = window(data, 0, 200)
    assert 0.1 < np.median(sampson(run, data.camera, 1)) < 0.2
    assert 0.2 < np.median(sampson(run, data.camera, 5)) < 0.45
    assert jnp.sum(run.visible, axis=1).max() == 40
