"""Every layout of a video gives its pictures, times, lens and truth, whole, in parts and lazily."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from bags import KINDS
from pictures import HEIGHT, WIDTH, brightness, picture
from refusals import refused
from videos import (
    LENS,
    NANOSECONDS,
    OWN,
    STAMPS,
    bag,
    euroc,
    kitti,
    kitti_in_colour,
    plain,
    pose,
    seven_scenes,
    timestamped,
    tum_rgbd,
)  # fmt: skip

from jaxslam.io.calibration import Calibration, from_field_of_view, write_calibration
from jaxslam.io.opening import open_recording, open_source
from jaxslam.io.tum import write_tum


@dataclass(frozen=True)
class Video:
    """How a video is written, and what is in it; pictures of brightness 5, 15, …"""

    write: Callable[[Path], Path]
    times: np.ndarray
    calibration: Calibration
    truth_times: np.ndarray | None = None
    truth: tuple[np.ndarray, ...] = ()
    shown: tuple[int, ...] = ()
    """Brightness of its pictures, where it is not 5, 15, …"""


def video(write, times, calibration, truth_times=None, truth=(), shown=()):
    shown = shown or tuple(10 * i + 5 for i in range(len(times)))
    return Video(write, np.array(times), calibration, truth_times, truth, shown)


LEFT = np.eye(4)
LEFT[0, 3] = -0.06
KITTI = [0.0, 0.104, 0.207], Calibration(WIDTH, HEIGHT, 70.0, 71.0, 30.0, 20.0), [0.0, 0.104, 0.207]
OF_EUROC = (-0.28, 0.07, 0.0002, 1.7e-05)
OF_KINECT = (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)
SECONDS = np.array([x / 1e9 for x in NANOSECONDS])
VIDEOS = {
    "timestamps": video(
        timestamped, [0.5, 0.6, 0.75], OWN, [0.5, 0.6], (pose(0), pose(1)), (5, 15, 35)
    ),
    "pictures": video(plain, np.arange(11) / 30, from_field_of_view(WIDTH, HEIGHT)),
    "TUM RGB-D": video(
        tum_rgbd, [5.25, 5.5], Calibration(640, 480, 520.9, 521.0, 325.1, 249.7, OF_KINECT),
        [5.3], (pose(0),),
    ),
    "EuRoC": video(
        euroc, SECONDS, Calibration(WIDTH, HEIGHT, 60.5, 61.5, 31.0, 23.0, OF_EUROC),
        SECONDS, (pose(1) @ pose(2), pose(1) @ pose(2)),
    ),
    "EuRoC, mav0": video(
        lambda x: euroc(x) / "mav0", SECONDS,
        Calibration(WIDTH, HEIGHT, 60.5, 61.5, 31.0, 23.0, OF_EUROC),
        SECONDS, (pose(1) @ pose(2), pose(1) @ pose(2)),
    ),
    "KITTI": video(kitti, *KITTI, tuple(pose(i) for i in range(3))),
    "KITTI in colour": video(kitti_in_colour, *KITTI, tuple(pose(i) @ LEFT for i in range(3))),
    "7 scenes": video(
        seven_scenes, [0, 1 / 30, 3 / 30], Calibration(640, 480, 585.0, 585.0, 320.0, 240.0),
        [0, 3 / 30], (pose(0), pose(3)),
    ),
    **{f"bag {name}": video(bag(name), STAMPS, LENS) for name in KINDS},
}  # fmt: skip
FOLDERS = [name for name in VIDEOS if not name.startswith("bag")]
LISTED = [name for name in FOLDERS if name != "pictures"]


@pytest.fixture
def written(request, tmp_path):
    """A video as it is, and where it was written."""
    of = VIDEOS[request.param]
    (tmp_path / "it").mkdir()
    return of, of.write(tmp_path / "it")


def of_videos(names):
    guess = pytest.mark.filterwarnings("ignore:.*has no calibration")
    every = pytest.mark.parametrize("written", names, indirect=True, ids=str)
    return lambda test: guess(every(test))


@of_videos(VIDEOS)
def test_a_video_has_its_pictures_times_lens_and_truth(written):
    of, path = written
    source = open_source(path)
    assert source.calibration == of.calibration
    # Doubles of seconds since 1970 are 2.4e-7 s apart.
    np.testing.assert_allclose(source.times, of.times, rtol=0, atol=1e-6)
    frames = list(source)
    assert [frame.index for frame in frames] == list(range(len(source)))
    assert [frame.time for frame in frames] == source.times.tolist()
    assert {frame.image.shape for frame in frames} == {
        (of.calibration.height, of.calibration.width)
    }
    assert {frame.image.dtype for frame in frames} == {np.dtype(np.uint8)}
    assert brightness(source) == list(of.shown)  # read again
    assert [int(image[0, 0]) for image in open_recording(str(path)).images()] == list(of.shown)
    if of.truth_times is None:
        assert source.reference is None
    else:
        assert source.reference is not None
        np.testing.assert_allclose(source.reference.times, of.truth_times, rtol=0, atol=1e-6)
        np.testing.assert_allclose(source.reference.T_wc, of.truth, rtol=0, atol=1e-8)


@of_videos(VIDEOS)
def test_a_part_of_a_video_is_its_frames_from_the_nearest_to_the_start(written):
    of, path = written
    since = of.times - of.times[0]
    for first in (0, 1):
        part = open_source(path, start=(0.4 + 0.2 * first) * since[1], every=2, frames=3)
        chosen = list(range(first, len(of.times), 2))[:3]
        assert [frame.index for frame in part] == chosen
        assert part.times.tolist() == open_source(path).times[chosen].tolist()
        assert brightness(part) == [of.shown[i] for i in chosen]


@of_videos(VIDEOS)
def test_what_is_given_takes_the_place_of_a_videos_own(written, tmp_path):
    of, path = written
    own, half = of.calibration, (of.calibration.width // 2, of.calibration.height // 2)
    lens = Calibration(own.width, own.height, 99.0, 99.0, 31.5, 23.5)
    write_calibration(tmp_path / "other.json", lens)
    write_tum(tmp_path / "other.txt", [7.0], np.eye(4)[None])
    given = {"calibration": tmp_path / "other.json", "reference": tmp_path / "other.txt"}
    source = open_source(path, **given, scale=0.5)
    assert source.calibration == lens.resized(*half)
    assert next(iter(source)).image.shape == half[::-1]
    assert source.reference is not None
    assert source.reference.times.tolist() == [7.0]
    assert open_source(path, fov=90.0).calibration == from_field_of_view(own.width, own.height, 90)
    if path.is_dir() and not path.name.endswith("run"):
        write_calibration(path / "calibration.json", lens)
        assert open_source(path).calibration == lens


@of_videos(FOLDERS)
def test_a_picture_that_is_broken_or_of_another_size_is_named_when_it_is_reached(written):
    of, path = written
    before, images = len(of.times) - 1, {x: cv2.imread(str(x), 0) for x in path.rglob("*.png")}
    last = [x for x, image in images.items() if image is not None and image[0, 0] == of.shown[-1]]
    for content, message in (
        (b"broken", rf"{last[0].name}: cannot be read as an image"),
        (cv2.imencode(".png", picture(0)[:-2])[1].tobytes(), rf"image {before} is 64x46, but the"),
    ):
        source = open_source(path)
        for name in last:
            name.write_bytes(content)
        frames = iter(source)
        assert [next(frames).index for _ in range(before)] == list(range(before))
        with pytest.raises(ValueError, match=message):
            next(frames)
        assert next(iter(source)).index == 0


@of_videos(LISTED)
def test_a_text_that_is_empty_or_of_something_else_is_named(written, tmp_path):
    _, path = written
    texts = (x for x in (tmp_path / "it").rglob("*") if x.suffix in (".txt", ".csv", ".yaml"))
    for text in texts:
        whole = text.read_bytes()
        for content in (b"", b"\x89PNG", b"x y z\n"):
            text.write_bytes(content)
            refused(open_source, text.name, path)
        text.write_bytes(whole)
