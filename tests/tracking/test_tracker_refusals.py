"""What the tracker and its files are not given is refused, in words that say what is accepted."""

import json
import sys
from functools import partial

import numpy as np
import pytest

import jaxslam
from jaxslam.io.tum import read_tum, write_tum
from jaxslam.tracking.film import OverlayWriter
from jaxslam.tracking.pointcloud import read_ply, write_ply
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.synthetic import render, room, synthetic_source
from jaxslam.tracking.target import KnownPoint, Target, read_target
from jaxslam.tracking.tracker import Tracker
from jaxslam.tracking.trajectory import absolute_trajectory_error, relative_pose_error
from jaxslam.tracking.video import track

SMALL = TrackerSettings(filter="world", wanted=12, spare=4)
TIMES = np.arange(60) / 30
PATH = np.tile(np.eye(4), (60, 1, 1))
PATH[:, :3, 3] = np.stack([np.sin(TIMES), 0.3 * np.cos(2 * TIMES), TIMES**2], axis=1)


def video():
    return synthetic_source(frames=2, width=320, height=240)


# --- files: each row is given a folder -----------------------------------------------------------


def text(name, content, read):
    """A file of that text, read."""

    def call(folder):
        (folder / name).write_text(content)
        return read(folder / name)

    return call


def tum(content):
    return text("bad.txt", content, read_tum)


def ply(content):
    return text("map.ply", content, read_ply)


def target(fields):
    return text("t.json", fields if isinstance(fields, str) else json.dumps(fields), read_target)


def point(**changes):
    return {"position": [0.0, 0.0, 0.0], "pixel": [1.0, 2.0], **changes}


def with_last(*points):
    return target({"points": [*SQUARE[:3], *points]})


SQUARE = [point(position=[x, y, 0.0]) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))]
LINE = [point(position=[x, 2 * x, 0]) for x in range(4)]


def film(name, picture=None):
    def call(folder):
        with OverlayWriter(folder / name, (64, 48), 30.0) as writer:
            if picture is not None:
                writer.write(picture)

    return call


def other_archive(folder):
    np.savez(folder / "t.npz", header=np.array("{}"), a=np.zeros(3))
    return Tracker.load(folder / "t.npz")


def never_tracked(folder):
    return Tracker(video().calibration, SMALL).save(folder / "t.npz")


def viewed(name, rerun=True):
    def call(folder):
        with pytest.MonkeyPatch.context() as patched:
            if rerun:
                pytest.importorskip("rerun")
            else:
                patched.setitem(sys.modules, "rerun", None)
            track(video(), folder / "out", SMALL, viewer=folder / name)

    return call


NO_MAP = r"map\.ply is not a map\.ply as jaxslam track writes it"
READ = [
    (tum("0 0 0 0 0 0 0 1\n1 2 3\n"), r"bad\.txt, line 2: expected eight finite"),
    (tum("0 0 0 zero 0 0 0 1\n"), r"bad\.txt, line 1: expected eight finite"),
    (tum("0 0 0 0 0 0 0 0\n"), r"bad\.txt, line 1: the quaternion is zero"),
    (tum("# nothing\n"), r"bad\.txt has no poses"),
    (lambda x: read_tum(x / "none.txt"), "cannot read the trajectory"),
    (ply(""), NO_MAP),
    (ply("property float x\nend_header\na"), NO_MAP),
    (target("{"), r"t\.json.* not a JSON file"),
    (target([1]), r"t\.json.* has no list of points"),
    (target({"points": 4}), r"t\.json.* has no list of points"),
    (target({"points": SQUARE[:3]}), r"t\.json.* has 3 points; at least 4"),
    (target({"points": SQUARE, "unit": "inch"}), r"t\.json.* unit must be metre, not 'inch'"),
    (with_last(5), r"t\.json.* point 3 must be an object, not 5"),
    (with_last(point(name="d", position=[0, 1])), r"t\.json.* position of point d must be 3 fin"),
    (with_last(point(position="x")), r"t\.json.* position of point 3 must be .* not .x."),
    (with_last(point(position="0 1 2")), "position of point 3 must be 3 finite numbers"),
    (with_last(point(position=[[0], [1], [2]])), "position of point 3 must be 3 finite numbers"),
    (with_last(point(pixel=None)), r"t\.json.* point 3 needs either a `pixel` .* or a `patch`"),
    (with_last(point(patch="no.png")), r"no\.png: cannot be read as an image"),
    (target({"points": LINE}), r"t\.json.* its points are on one line"),
    (lambda x: read_target(x / "nowhere.json"), "cannot read the target"),
    (lambda x: Tracker.load(x / "t.npz"), r"t\.npz does not exist"),
    (text("t.npz", "nothing", Tracker.load), r"t\.npz: not an npz file of numbers \(it is another"),
    (other_archive, r"t\.npz is not a saved tracker"),
]
WRITTEN = [
    (lambda x: write_tum(x / "t.txt", [0, 1], np.eye(4)[None]), "2 times for 1 poses"),
    (film("overlay.gif"), r"must end in \.mp4"),
    (film("missing/overlay.mp4"), "cannot be opened"),
    (film("overlay.mp4", np.zeros((48, 66, 3), np.uint8)), "does not fit"),
    (lambda x: write_ply(x / "map.ply", np.zeros((2, 3)), np.eye(3)[None], [1, 2], [0, 0]),
     "2 points, 1 covariances"),
    (lambda x: write_ply(x / "map.ply", [[np.nan, 0, 0]], np.eye(3)[None], [1], [0]), "not finite"),
    (never_tracked, "without any frame"),
    (viewed("seen.rrd", rerun=False), r"needs the viewer extra \(rerun is missing\)"),
    (viewed("seen.mp4"), r"seen\.mp4: the name must end in \.rrd"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "message"), READ + WRITTEN)
def test_a_file_that_makes_no_sense_is_refused_and_none_is_written(call, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        call(tmp_path)
    assert (call, message) in READ or not list(tmp_path.iterdir())


# --- calls ---------------------------------------------------------------------------------------


def forward():
    T = np.eye(4)
    T[2, 3] = 2.0
    return render(room(0, 131.2), T, synthetic_source(1, width=160, height=120).calibration)


def begun_with_a_target(**settings):
    pixels = np.array([[10.0, 10.0], [90.0, 10.0], [90.0, 80.0], [10.0, 80.0]])
    corners = np.array([x["position"] for x in SQUARE])
    points = [KnownPoint(str(i), corners[i], pixel=pixels[i]) for i in range(4)]
    return lambda: Tracker(
        video().calibration, TrackerSettings(**settings), target=Target(tuple(points))
    )


GREY = np.zeros((240, 320), np.uint8)
STILL = np.tile(np.eye(4), (60, 1, 1))
OF_CALLS = [
    (lambda: absolute_trajectory_error(TIMES + 100, PATH, TIMES, PATH), "0 poses"),
    (lambda: absolute_trajectory_error(TIMES[:2], PATH[:2], TIMES, PATH), "2 poses"),
    (lambda: absolute_trajectory_error(TIMES, STILL, TIMES, PATH), "coincide"),
    (lambda: relative_pose_error(TIMES, PATH, TIMES, PATH, seconds=1e4), "no two poses"),
    (lambda: synthetic_source(frames=0), "frames must be positive"),
    (lambda: synthetic_source(rate=0.0), "rate must be positive"),
    (forward, "closer than"),
    (lambda: TrackerSettings(calibration="maybe"),
     "unknown calibration 'maybe'; known: white, consider"),
    (lambda: TrackerSettings(filter="nothing"), "unknown .* 'nothing'; known:"),
    (lambda: TrackerSettings(landmarks="nothing"), "unknown .* 'nothing'; known:"),
    *[
        (partial(TrackerSettings, **{name: value}), f"{name} must .*, not {value}")
        for name, value in (("nearest_depth", 0), ("wanted", 0), ("spare", -1), ("pixel_sigma", 0))
    ],
    (lambda: jaxslam.InverseDepth.beyond(-1.0), "the nearest depth must be positive, not -1.0"),
    *[
        (begun_with_a_target(filter=name), rf"filter {name.replace('+', '.')} cannot begin with a")
        for name in ("scale_gauge", "world+scene50", "world+mixture3")
    ],
    (begun_with_a_target(filter="world", wanted=3),
     "the target has 4 points, but only 3 landmarks are wanted"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "message"), OF_CALLS)
def test_what_makes_no_sense_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


PICTURES = [
    (np.zeros((240, 321), np.uint8), 1.0, "frame 1 is 321x240, but the calibration is for 320x240"),
    (np.zeros((240, 320, 4), np.uint8), 1.0, r"not of shape \(240, 320, 4\)"),
    (np.zeros((0, 0), np.uint8), 1.0, r"not of shape \(0, 0\)"),
    (np.zeros((240, 320), np.uint16), 1.0, "not uint16"),
    (np.full((240, 320), 255.0), 1.0, "not floats from 255 to 255"),
    (GREY, 0.0, "its time, 0.0 s, is not later"),
    (GREY, np.nan, "its time, nan s, is not later"),
]


def test_a_picture_that_cannot_be_is_refused_and_changes_nothing():
    source = video()
    first, second = source
    touched, untouched = (Tracker(source.calibration, SMALL) for _ in range(2))
    with pytest.raises(ValueError, match="its time, nan s"):
        touched.step(first.image, np.nan)
    for tracker in (touched, untouched):
        tracker.track(first)
    for image, time, message in PICTURES:
        with pytest.raises(ValueError, match=message):
            touched.step(image, time)
    with pytest.raises(ValueError, match="is not later than that of the previous frame"):
        touched.track(first)
    one, other = touched.track(second), untouched.track(second)
    assert one.index == other.index == 1
    np.testing.assert_array_equal(one.T_wc, other.T_wc)
    np.testing.assert_array_equal(one.covariance, other.covariance)
    assert (one.status, one.nis) == (other.status, other.nis)
