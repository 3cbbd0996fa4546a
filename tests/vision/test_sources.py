"""Videos in every layout on disk, and every way in which such a layout can be wrong."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from jaxslam.vision.calibration import Calibration, write_calibration
from jaxslam.vision.sources import open_source
from jaxslam.vision.trajectory import write_tum

DATA = Path(__file__).parents[3] / "shared" / "data"
WIDTH, HEIGHT = 64, 48


def picture(index):
    """A grey image that tells its index by its brightness."""
    return np.full((HEIGHT, WIDTH), 10 * index + 5, np.uint8)


@pytest.fixture
def calibration(tmp_path):
    path = tmp_path / "camera.json"
    write_calibration(path, Calibration(WIDTH, HEIGHT, 60.0, 60.0, 31.5, 23.5))
    return path


@pytest.fixture
def folder(tmp_path):
    """Images 1 to 11 without leading zeros."""
    path = tmp_path / "pictures"
    path.mkdir()
    for index in range(1, 12):
        cv2.imwrite(str(path / f"frame{index}.png"), picture(index))
    (path / "notes.txt").write_text("not an image")
    return path


@pytest.fixture
def timestamped(tmp_path):
    """The layout with timestamps.txt, four frames, and a reference."""
    path = tmp_path / "walk"
    (path / "images").mkdir(parents=True)
    for index in range(4):
        cv2.imwrite(str(path / "images" / f"{index}.png"), picture(index))
    set_lines(path, "# seconds file", "0.5 0.png", "0.6 1.png", "0.75 3.png")
    write_calibration(path / "calibration.json", Calibration(WIDTH, HEIGHT, 60, 60, 31.5, 23.5))
    write_tum(path / "groundtruth.txt", [0.5, 0.6], np.tile(np.eye(4), (2, 1, 1)))
    return path


def set_lines(path, *lines):
    (path / "timestamps.txt").write_text("\n".join(lines) + "\n")


def brightness(source):
    return [int(frame.image[0, 0]) for frame in source]


def test_timestamped_layout_gives_named_images_at_stated_times(timestamped):
    source = open_source(timestamped)
    frames = list(source)
    assert source.name == "walk"
    assert len(source) == 3
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert [frame.time for frame in frames] == [0.5, 0.6, 0.75]
    assert brightness(source) == [5, 15, 35]
    assert frames[0].image.dtype == np.uint8
    assert frames[0].image.shape == (HEIGHT, WIDTH)
    assert source.reference is not None
    assert source.reference.times.tolist() == [0.5, 0.6]


def test_reference_and_calibration_can_be_overridden(timestamped, tmp_path, calibration):
    write_tum(tmp_path / "other.txt", [7.0], np.eye(4)[None])
    write_calibration(calibration, Calibration(WIDTH, HEIGHT, 99.0, 99.0, 31.5, 23.5))
    source = open_source(timestamped, calibration=calibration, reference=tmp_path / "other.txt")
    assert source.reference is not None
    assert source.reference.times.tolist() == [7.0]
    assert source.calibration.fx == 99.0


def test_plain_folder_is_sorted_by_number(folder, calibration):
    source = open_source(folder, calibration=calibration, rate=20.0)
    assert brightness(source) == [10 * index + 5 for index in range(1, 12)]
    np.testing.assert_allclose(source.times, np.arange(11) / 20, rtol=0, atol=1e-12)
    assert source.reference is None


def test_video_is_read_with_its_own_rate(tmp_path, calibration):
    path = tmp_path / "video.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 25.0, (WIDTH, HEIGHT))
    for index in range(6):
        writer.write(cv2.cvtColor(picture(3 * index), cv2.COLOR_GRAY2BGR))
    writer.release()
    source = open_source(path, calibration=calibration)
    assert len(source) == 6
    np.testing.assert_allclose(source.times, np.arange(6) / 25, rtol=0, atol=1e-12)
    # Compression changes the grey levels a little.
    np.testing.assert_allclose(brightness(source), [5, 35, 65, 95, 125, 155], atol=4)


def test_reading_is_lazy_and_can_be_repeated(timestamped):
    source = open_source(timestamped)
    (timestamped / "images" / "3.png").write_bytes(b"broken")
    frames = iter(source)
    assert next(frames).index == 0
    assert next(frames).index == 1
    with pytest.raises(ValueError, match=r"3\.png: cannot be read as an image"):
        next(frames)
    assert next(iter(source)).index == 0


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["0.5 0.png", "0.5 1.png"], r"line 2: time 0\.5 s does not come after"),
        (["# x", "0.5 0.png", "0.4 1.png"], "line 3: time"),
        (["nan 0.png"], "line 1: .*finite"),
        (["zero 0.png"], "line 1: .*finite"),
        (["0.5"], "line 1: "),
        (["0.5 9.png"], r"names 9\.png, but .* is missing"),
        (["# empty"], "holds no lines"),
    ],
)
def test_bad_timestamps_are_refused_naming_the_line(timestamped, lines, words):
    set_lines(timestamped, *lines)
    with pytest.raises(ValueError, match=words) as caught:
        open_source(timestamped)
    assert "timestamps.txt" in str(caught.value)


def test_timestamps_that_are_not_text_are_refused(timestamped):
    (timestamped / "timestamps.txt").write_bytes(b"\x89PNG")
    with pytest.raises(ValueError, match=r"timestamps\.txt: cannot be read as text"):
        open_source(timestamped)


def test_image_of_another_size_is_refused(folder, calibration):
    cv2.imwrite(str(folder / "frame5.png"), np.zeros((HEIGHT, WIDTH + 2), np.uint8))
    source = open_source(folder, calibration=calibration)
    with pytest.raises(ValueError, match="image 4 is 66x48, the calibration is for 64x48"):
        list(source)
    cv2.imwrite(str(folder / "frame1.png"), np.zeros((HEIGHT, WIDTH + 2), np.uint8))
    with pytest.raises(ValueError, match="image 0 is 66x48"):
        open_source(folder, calibration=calibration)


def test_what_is_no_source_is_refused(tmp_path, folder, calibration):
    with pytest.raises(ValueError, match="no such file or folder"):
        open_source(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="comes without a calibration"):
        open_source(folder)
    with pytest.raises(ValueError, match="rate is 0"):
        open_source(folder, calibration=calibration, rate=0)
    with pytest.raises(ValueError, match=r"unknown kind of source; accepted: a video file"):
        open_source(folder / "notes.txt", calibration=calibration)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="holds no images"):
        open_source(tmp_path / "empty", calibration=calibration)
    (tmp_path / "text.mp4").write_text("no video")
    with pytest.raises(ValueError, match="cannot be read as a video"):
        open_source(tmp_path / "text.mp4", calibration=calibration)


@pytest.mark.parametrize(
    ("name", "frames"), [("costado", 720), ("slider_depth", 87), ("kitti06_first51", 51)]
)
def test_shared_videos_open(name, frames):
    if not (DATA / name).is_dir():
        pytest.skip(f"the shared data set {name} is not beside this repository")
    source = open_source(DATA / name)
    assert len(source) == frames
    frame = next(iter(source))
    assert frame.image.shape == (source.calibration.height, source.calibration.width)
    assert frame.image.std() > 5
    assert source.reference is not None
    turns = source.reference.T_wc[:, :3, :3]
    np.testing.assert_allclose(
        turns @ turns.transpose(0, 2, 1), np.tile(np.eye(3), (len(turns), 1, 1)), atol=1e-9
    )
