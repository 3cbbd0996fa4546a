"""A recording for rerun holds what was tracked, and is there whatever ends the run."""

import numpy as np
import pytest

pytest.importorskip("cv2")

from jaxslam.tracking.pose_with_covariance import PoseWithCovariance
from jaxslam.tracking.report import Tracked
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.synthetic import synthetic_source
from jaxslam.tracking.video import track
from jaxslam.tracking.viewer import Viewer

SETTINGS = TrackerSettings(filter="world", wanted=12, spare=4)
FRAMES = 4


def read(path):
    """Rows of every entity, in order of frames: their frame and the rest by name."""
    chunk = pytest.importorskip("rerun.chunk")
    rows = {}
    for part in chunk.RrdReader(path).stream():
        rows.setdefault(part.entity_path, []).extend(part.to_record_batch().to_pylist())
    timed = {name: [row for row in some if "frame" in row] for name, some in rows.items()}
    return {name: sorted(some, key=lambda row: row["frame"]) for name, some in timed.items()}


def of(rows, column):
    """The values of a component, as of `Scalars:scalars`."""
    return [row[next(name for name in row if name.endswith(column))] for row in rows]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    pytest.importorskip("rerun")
    out = tmp_path_factory.mktemp("recorded")
    path = out / "new" / "seen.rrd"
    summary = track(
        synthetic_source(frames=FRAMES, width=160, height=120), out, SETTINGS, viewer=path
    )
    return out, read(path), summary


def test_every_frame_is_recorded_with_its_picture_and_camera(recorded):
    out, rows, _ = recorded
    pose, image = rows["/world/camera"], rows["/world/camera/image"]
    assert [row["frame"] for row in pose] == [row["frame"] for row in image] == [0, 1, 2, 3]
    positions = np.loadtxt(out / "trajectory.txt")[:, 1:4]
    # Single precision.
    np.testing.assert_allclose(
        np.array(of(pose, "translation"))[:, 0], positions, rtol=0, atol=1e-6
    )
    assert all(bytes(blob[0])[:2] == b"\xff\xd8" for blob in of(image, "blob"))  # JPEG
    (path,) = {name for name in rows if name.startswith("/world/path/")}
    whole = of(rows[path], "strips")[-1][0]
    np.testing.assert_allclose(whole, positions, rtol=0, atol=1e-6)


def test_numbers_are_those_of_the_table(recorded):
    out, rows, _ = recorded
    table = np.genfromtxt(out / "frames.csv", delimiter=",", names=True, dtype=None)
    for name in ("position", "orientation"):
        values = np.array(of(rows[f"/sigma/{name}"], "scalars"))[:, 0]
        np.testing.assert_allclose(values, table[f"sigma_{name}"], rtol=1e-5)
    nis = np.array(of(rows["/nis/per_dof"], "scalars"))[:, 0]
    np.testing.assert_allclose(nis, (table["nis"][1:] / table["nis_dof"][1:]), rtol=1e-5)
    assert "/sigma/log_scale" not in rows  # of a filter in map units
    assert of(rows["/state"], "text") == [["frame 0: start, map 0"], ["frame 1: tracked, map 0"]]


def test_what_was_sought_and_found_is_recorded(recorded):
    _, rows, summary = recorded
    found = of(rows["/world/camera/image/matched/found"], "positions")
    assert sum(map(len, found)) == summary["matches_per_frame"] * (FRAMES - 1)
    searched = of(rows["/world/camera/image/matched/searched"], "strips")
    assert [len(some) for some in searched] == [len(some) for some in found]
    created = of(rows["/world/camera/image/new/found"], "positions")
    assert sum(map(len, created)) == summary["landmarks"]["created"]


def test_ends_of_submaps_and_loops_to_them_are_recorded(tmp_path):
    pytest.importorskip("rerun")
    source = synthetic_source(frames=5, width=160, height=120)
    frames, at = list(source), np.zeros((5, 3))
    at[:, 0] = [0, 1, 2, 3, 0.5]
    with Viewer(tmp_path / "graph.rrd", source.calibration) as viewer:
        for frame, position, submap, loop in zip(
            frames, at, (0, 0, 1, 2, 3), (None, None, None, None, 0), strict=True
        ):
            T_wc = np.eye(4)
            T_wc[:3, 3] = position
            camera = PoseWithCovariance(T_wc)
            viewer.show(frame, Tracked(frame.index, frame.time, camera, submap=submap, loop=loop))
    rows = read(tmp_path / "graph.rrd")
    ends = of(rows["/world/graph/submaps"], "positions")
    assert [len(some) for some in ends] == [1, 2, 3]
    np.testing.assert_allclose(np.array(ends[-1]), at[1:4])
    (loops,) = of(rows["/world/graph/loops"], "strips")
    np.testing.assert_allclose(np.array(loops), [[at[4], at[1]]])
