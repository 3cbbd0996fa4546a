"""Folders of images, the part of a video that is wanted, and every way in which it can be wrong."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from pictures import HEIGHT, WIDTH, brightness, picture

from jaxslam.io.calibration import Calibration, from_field_of_view, write_calibration
from jaxslam.io.opening import open_source
from jaxslam.io.source import selected
from jaxslam.io.tum import write_tum

DATA = Path(__file__).parents[3] / "shared" / "data"


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
        (["# empty"], "has no lines"),
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
    with pytest.raises(ValueError, match="image 4 is 66x48, but the calibration is for 64x48"):
        list(source)
    cv2.imwrite(str(folder / "frame1.png"), np.zeros((HEIGHT, WIDTH + 2), np.uint8))
    with pytest.raises(ValueError, match="image 0 is 66x48"):
        open_source(folder, calibration=calibration)


def test_what_is_no_source_is_refused(tmp_path, folder, calibration):
    with pytest.raises(ValueError, match="no such file or folder"):
        open_source(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="not both"):
        open_source(folder, calibration=calibration, fov=60.0)
    with pytest.raises(ValueError, match="rate must be a positive number"):
        open_source(folder, calibration=calibration, rate=0)
    with pytest.raises(ValueError, match=r"a file \.txt, not a known kind of source; known: the"):
        open_source(folder / "notes.txt", calibration=calibration)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="a folder with nothing in it, not a known kind"):
        open_source(tmp_path / "empty", calibration=calibration)
    (tmp_path / "empty" / "deeper").mkdir()
    (tmp_path / "empty" / "a.txt").touch()
    with pytest.raises(ValueError, match=r"a folder with a\.txt, deeper/, …, not a known .* EuRoC"):
        open_source(tmp_path / "empty", calibration=calibration)


def test_without_a_calibration_a_lens_is_guessed_and_said_so(folder):
    with pytest.warns(UserWarning, match="pictures has no calibration: .* 65°"):
        source = open_source(folder)
    assert source.calibration == from_field_of_view(WIDTH, HEIGHT)


def test_a_field_of_view_takes_the_place_of_a_calibration(timestamped):
    assert open_source(timestamped, fov=90.0).calibration == from_field_of_view(WIDTH, HEIGHT, 90.0)


def test_every_third_frame_from_the_nearest_to_the_start(folder, calibration):
    whole = open_source(folder, calibration=calibration, rate=10.0)
    part = open_source(folder, calibration=calibration, rate=10.0, start=0.26, every=3, frames=2)
    chosen = [frame for frame in whole if frame.index in (3, 6)]
    assert len(part) == 2
    assert part.times.tolist() == [frame.time for frame in chosen]
    for frame, expected in zip(part, chosen, strict=True):
        assert (frame.index, frame.time) == (expected.index, expected.time)
        np.testing.assert_array_equal(frame.image, expected.image)
    rest = open_source(folder, calibration=calibration, rate=10.0, start=0.24)
    assert [frame.index for frame in rest] == list(range(2, 11))


def test_a_selection_of_a_selection_counts_in_the_whole_video(folder, calibration):
    part = open_source(folder, calibration=calibration, rate=10.0, start=0.1, every=2)
    again = selected(part, start=0.4, every=2)
    assert [frame.index for frame in again] == [5, 9]
    assert brightness(again) == [10 * (5 + 1) + 5, 10 * (9 + 1) + 5]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"every": 0}, "every must be a positive whole number, not 0"),
        ({"frames": 0}, "frames must be a positive whole number, not 0"),
        ({"start": -1.0}, r"start is -1\.0 s; pictures has frames from 0 to 1\.000 s"),
        ({"start": 1.1}, r"start is 1\.1 s; pictures has frames from 0 to 1\.000 s"),
        ({"start": float("nan")}, "start is nan s"),
        ({"scale": 0.0}, r"scale must be a positive factor .* not 0\.0"),
        ({"scale": 0.001}, "width would be 0; it must be at least one pixel"),
    ],
)
def test_a_selection_of_nothing_is_refused(folder, calibration, options, message):
    with pytest.raises(ValueError, match=message):
        open_source(folder, calibration=calibration, rate=10.0, **options)


def test_a_smaller_picture_and_its_calibration_see_a_point_in_the_same_direction(tmp_path):
    """A bright spot, where the scaled calibration has it."""
    draw = np.random.default_rng(0)
    camera = Calibration(320, 240, 300.0, 310.0, 150.0, 125.0)
    write_calibration(tmp_path / "calibration.json", camera)
    (tmp_path / "images").mkdir()
    ray = np.array([0.21, -0.13, 1.0])
    u, v, _ = camera.matrix @ ray
    y, x = np.mgrid[:240, :320]
    image = 200 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 6.0**2)) + draw.uniform(0, 1)
    cv2.imwrite(str(tmp_path / "images" / "0.png"), np.rint(image).astype(np.uint8))
    set_lines(tmp_path, "0 0.png")
    source = open_source(tmp_path, scale=0.4)
    (frame,) = source
    assert frame.image.shape == (96, 128)
    weight = np.where(frame.image > 20, frame.image, 0).astype(float)
    y, x = np.mgrid[:96, :128]
    centre = np.array([np.sum(weight * x), np.sum(weight * y)]) / weight.sum()
    # Grey levels are whole; pixels counted from the corner would be 0.3 off.
    np.testing.assert_allclose(centre, (source.calibration.matrix @ ray)[:2], rtol=0, atol=0.05)


@pytest.mark.parametrize(
    ("size", "tracked"),
    [((1280, 960), (1280, 960)), ((1920, 1080), (960, 540)), ((1080, 2700), (360, 900))],
)
def test_pictures_too_large_are_made_smaller_with_their_calibration(tmp_path, size, tracked):
    camera = Calibration(size[0], size[1], 1000.0, 1000.0, 500.0, 500.0)
    write_calibration(tmp_path / "calibration.json", camera)
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images" / "0.png"), np.zeros(size[::-1], np.uint8))
    set_lines(tmp_path, "0 0.png")
    if size == tracked:
        source = open_source(tmp_path)
    else:
        part = size[0] // tracked[0]
        told = f"pictures of {size[0]}x{size[1]} are reduced to 1/{part} of their size"
        with pytest.warns(UserWarning, match=told):
            source = open_source(tmp_path)
    assert source.calibration == camera.resized(*tracked)
    assert next(iter(source)).image.shape == tracked[::-1]
    assert open_source(tmp_path, scale=1).calibration == camera


def test_a_picture_of_another_size_is_refused_before_it_is_scaled(folder, calibration):
    cv2.imwrite(str(folder / "frame5.png"), np.zeros((HEIGHT, WIDTH + 2), np.uint8))
    source = open_source(folder, calibration=calibration, scale=0.5)
    with pytest.raises(ValueError, match="image 4 is 66x48, but the calibration is for 64x48"):
        list(source)


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
