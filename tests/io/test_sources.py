"""What is no video, or no part of one, is refused; pictures that are too large; shared videos.

That every layout is read whole, in parts and lazily is a law of videos.
"""

from pathlib import Path

import cv2
import numpy as np
import pytest
from pictures import HEIGHT, WIDTH, brightness
from videos import euroc, kitti, plain, seven_scenes, timestamped, tum_rgbd, words

from jaxslam.io.calibration import Calibration, from_field_of_view, write_calibration
from jaxslam.io.opening import open_source
from jaxslam.io.source import selected

DATA = Path(__file__).parents[3] / "shared" / "data"


def put(file, text):
    return lambda path: (path / file).write_text(text)


def listed(*lines):
    return put("timestamps.txt", "\n".join(lines) + "\n")


def instead(file, old, new):
    def spoil(path):
        (path / file).write_text((path / file).read_text().replace(old, new))

    return spoil


def without_a_picture(path):
    next((path / "mav0" / "cam0" / "data").iterdir()).unlink()


def nothing(path):
    """Whole files."""


def wide(path):
    cv2.imwrite(str(path / "frame1.png"), np.zeros((HEIGHT, WIDTH + 2), np.uint8))


def deeper(path):
    (path / "deeper").mkdir()
    (path / "a.txt").touch()


def empty(folder):
    return folder


YAML = "mav0/cam0/sensor.yaml"
REFUSED = [
    (euroc, instead(YAML, "radial-tangential", "fov"), r"yaml: unknown lens, pinhole fov; ex"),
    (euroc, instead(YAML, "61.5, ", ""), r"sensor\.yaml: has no camera matrix"),
    (euroc, instead(YAML, "60.5", "nan"), r"sensor\.yaml: has no camera matrix of finite"),
    (euroc, without_a_picture, r"data\.csv names \d+\.png, but .* is missing"),
    (kitti, put("times.txt", "0\n0.1\n"), r"times\.txt has 2 lines for 3 images"),
    (kitti, put("times.txt", "0\n0.1\n0.1\n"), r"times\.txt, line 3: time 0\.1 s does not come"),
    (kitti, put("times.txt", "0\nx\n0.1\n"), r"times\.txt, line 2: expected finite times in sec"),
    (kitti, put("calib.txt", "P1: 1 2 3\n"), r"calib\.txt has no line P0:"),
    (kitti, put("calib.txt", "P0: 1 2 3\n"), r"calib\.txt, line 1: expected P0: and twelve numb"),
    (kitti, put("poses.txt", "1 0 0 0 0 1 0 0 0 0 1\n"), r"poses\.txt, line 1: expected 12 finite"),
    (kitti, put("poses.txt", words(np.eye(4)[:3])), r"poses\.txt has 1 lines for 3 images"),
    (seven_scenes, put("frame-000003.pose.txt", "1 0 0 0\n"), r"0003\.pose\.txt has 1 rows; expec"),
    (timestamped, listed("0.5 0.png", "0.5 1.png"), r"s\.txt, line 2: time 0\.5 s does not come a"),
    (timestamped, listed("nan 0.png"), r"timestamps\.txt, line 1: .*finite"),
    (timestamped, listed("0.5"), r"timestamps\.txt, line 1: "),
    (timestamped, listed("0.5 9.jpg"), r"timestamps\.txt names 9\.jpg, but .* is missing"),
    (timestamped, listed("# empty"), r"timestamps\.txt has no lines"),
    (plain, wide, "image 0 is 66x48"),
    (lambda x: x / "nowhere", nothing, "no such file or folder"),
    (lambda x: plain(x) / "notes.md", nothing, r"a file \.md, not a known kind of source; known:"),
    (empty, nothing, "a folder with nothing in it, not a known kind"),
    (empty, deeper, r"a folder with a\.txt, deeper/, …, not a known .* EuRoC"),
]


def test_tum_vi_has_the_fisheye_of_its_camchain(tmp_path):
    path, four = euroc(tmp_path), (0.003, 0.0007, -0.002, 0.0002)
    (path / YAML).unlink()
    (path / "dso").mkdir()
    (path / "dso" / "camchain.yaml").write_text(
        "cam0:\n  camera_model: pinhole\n  intrinsics: [60.5, 61.5, 31.0, 23.0]\n"
        f"  resolution: [{WIDTH}, {HEIGHT}]\n"
        f"  distortion_model: equidistant\n  distortion_coeffs: [{words(four, ', ')}]\n"
    )
    lens = Calibration(WIDTH, HEIGHT, 60.5, 61.5, 31.0, 23.0, four, model="fisheye")
    assert open_source(path).calibration == lens


@pytest.mark.parametrize(("write", "spoil", "message"), REFUSED)
def test_what_is_no_video_is_refused_by_file_and_line(write, spoil, message, tmp_path, calibration):
    (tmp_path / "it").mkdir()
    path = write(tmp_path / "it")
    spoil(path)
    with pytest.raises(ValueError, match=message):
        open_source(path, calibration=calibration if write is plain else None)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fov": 60.0}, "not both"),
        ({"rate": 0}, "rate must be a positive number"),
        ({"every": 0}, "every must be a positive whole number, not 0"),
        ({"frames": 0}, "frames must be a positive whole number, not 0"),
        ({"start": -1.0}, r"start is -1\.0 s; pictures has frames from 0 to 1\.000 s"),
        ({"start": 1.1}, r"start is 1\.1 s; pictures has frames from 0 to 1\.000 s"),
        ({"scale": 0.0}, r"scale must be a positive factor .* not 0\.0"),
        ({"scale": 0.001}, "width would be 0; it must be at least one pixel"),
    ],
)
def test_options_that_make_no_sense_are_refused(tmp_path, calibration, options, message):
    path = plain(tmp_path / "pictures")
    with pytest.raises(ValueError, match=message):
        open_source(path, **({"calibration": calibration, "rate": 10.0} | options))


def test_a_selection_of_a_selection_counts_in_the_whole_video(tmp_path, calibration):
    source = open_source(plain(tmp_path), calibration=calibration, rate=20.0)
    np.testing.assert_allclose(source.times, np.arange(11) / 20, rtol=0, atol=1e-12)
    again = selected(selected(source, start=0.05, every=2), start=0.2, every=2)
    assert [frame.index for frame in again] == [5, 9]
    assert brightness(again) == [55, 95]


def test_without_a_calibration_a_lens_is_guessed_and_said_so(tmp_path):
    with pytest.warns(UserWarning, match="pictures has no calibration: .* 65°"):
        source = open_source(plain(tmp_path / "pictures"))
    assert source.calibration == from_field_of_view(WIDTH, HEIGHT)
    other = tum_rgbd(tmp_path).rename(tmp_path / "mine")  # which names no camera
    with pytest.warns(UserWarning, match="has no calibration"):
        assert open_source(other).calibration.guessed


def test_a_picture_of_seven_scenes_may_lack_its_pose(tmp_path):
    path = seven_scenes(tmp_path)
    (path / "frame-000000.pose.txt").unlink()
    reference = open_source(path).reference
    assert reference is not None
    np.testing.assert_allclose(reference.times, [3 / 30], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("size", "tracked"),
    [((1280, 960), (1280, 960)), ((1080, 2700), (360, 900))],
)
def test_pictures_too_large_are_made_smaller_with_their_calibration(tmp_path, size, tracked):
    camera = Calibration(size[0], size[1], 1000.0, 1000.0, 500.0, 500.0)
    write_calibration(tmp_path / "calibration.json", camera)
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images" / "0.png"), np.zeros(size[::-1], np.uint8))
    listed("0 0.png")(tmp_path)
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


@pytest.mark.parametrize(
    ("name", "pinhole", "distortion"),
    [
        ("fr1_xyz", (517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
        ("freiburg3_office", (535.4, 539.2, 320.1, 247.6), ()),
    ],
)
def test_the_kinects_of_tum_have_their_own_lenses(tmp_path, name, pinhole, distortion):
    """As the benchmark's page has them, in pixels; the second one is a row of the laws."""
    path = tum_rgbd(tmp_path)
    source = open_source(path.rename(path.with_name(name)))
    assert source.calibration == Calibration(640, 480, *pinhole, distortion)
