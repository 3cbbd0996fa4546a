"""What is no video, or no part of one, is refused; pictures that are too large; shared videos.

That every layout is read whole, in parts and lazily is a law of videos.
"""

import contextlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from pictures import HEIGHT, WIDTH, brightness, jpeg, write_pictures
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
    (euroc, instead(YAML, "60.5", "nan"), r"sensor\.yaml: fx must be finite, not nan"),
    (euroc, without_a_picture, r"data\.csv names \d+\.png, but .* is missing"),
    (kitti, put("times.txt", "0\n0.1\n"), r"06\.txt has 3 lines for 2 times"),
    (kitti, put("times.txt", "0\n0.1\n0.1\n"), r"times\.txt, line 3: time 0\.1 s does not come"),
    (kitti, put("times.txt", "0\nx\n0.1\n"), r"times\.txt, line 2: expected a finite time"),
    (kitti, put("calib.txt", "P1: 1 2 3\n"), r"calib\.txt has no line P0:"),
    (kitti, put("calib.txt", "P0: 1 2 3\n"), r"calib\.txt, line 1: expected P0: and twelve numb"),
    (kitti, put("calib.txt", f"P0:{12 * ' 0'}\n"), r"calib\.txt, line 1: not a projection matrix"),
    (kitti, put("poses.txt", "1 0 0 0 0 1 0 0 0 0 1\n"), r"poses\.txt, line 1: expected 12 finite"),
    (kitti, put("poses.txt", words(np.eye(4)[:3])), r"poses\.txt has 1 lines for 3 times"),
    (seven_scenes, put("frame-000003.pose.txt", "1 0 0 0\n"), r"0003\.pose\.txt has 1 rows; expec"),
    (seven_scenes, put("frame-x.color.png", ""), r"x\.color\.png: expected the name frame-NUMBER"),
    (timestamped, listed("0.5 0.png", "0.5 1.png"), r"s\.txt, line 2: time 0\.5 s does not come a"),
    (timestamped, listed("nan 0.png"), r"timestamps\.txt, line 1: .*finite"),
    (timestamped, listed("0.5"), r"there are 1 times for 4 pictures"),
    (timestamped, listed("0.5 9.jpg"), r"timestamps\.txt names 9\.jpg, but .* is missing"),
    (timestamped, listed("# empty"), r"timestamps\.txt has no lines"),
    (plain, wide, "image 0 is 66x48"),
    (lambda x: x / "nowhere", nothing, "no such file or folder"),
    (lambda x: f"{x}:/camera", nothing, "is no bag: only a bag has topics"),
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


SECONDS = [0.0, 0.05, 0.1, 0.2]
SINCE_1970 = [1403636579.763555584 + x for x in SECONDS]
TAKEN = "the names of the pictures are taken as their times"


@pytest.mark.parametrize(
    ("names", "times", "words"),
    [
        *[([f"{round(x * n)}" for x in SINCE_1970], SECONDS, TAKEN) for n in (1e9, 1e6, 1e3)],
        ([f"frame_{round(x * 1e9)}_left" for x in SINCE_1970], SECONDS, TAKEN),
        ([f"img_{x:.9f}".replace(".", "_") for x in SINCE_1970], SECONDS, TAKEN),
        ([f"img_1305031102_{x}00000000" for x in (1, 2, 3, 5)], [0.0, 0.1, 0.2, 0.4], TAKEN),
        ([f"1305031102.{x}" for x in ("1", "13", "2", "25")], [0.0, 0.03, 0.1, 0.15], TAKEN),
        ([f"{1403636579763 + 1000 * x}" for x in range(4)], [0.0, 1.0, 2.0, 3.0], TAKEN),
        (
            [f"cam0_{x}" for x in (1, 2, 9, 10)],
            [0.0, 0.1, 0.8, 0.9],
            "6 pictures are missing by their numbers, and their time is kept",
        ),
        ([f"{x:06d}.color" for x in (0, 5, 10, 15)], [0.0, 0.1, 0.2, 0.3], ""),
        (["0.1", "0.13", "0.2", "0.25"], [0.0, 0.1, 0.2, 0.3], ""),
        (
            [f"IMG_20230501_12345{x}" for x in (1, 2, 4, 9)],
            [0.0, 0.1, 0.2, 0.3],
            r"names are not read as times; --rate \(10 pictures per second\) is taken",
        ),
    ],
)
def test_names_tell_the_order_of_pictures_and_their_times(
    tmp_path, calibration, names, times, words
):
    write_pictures(tmp_path / "film", [f"{name}.png" for name in names])
    with pytest.warns(UserWarning, match=words) if words else contextlib.nullcontext():
        source = open_source(tmp_path / "film", calibration=calibration, rate=10.0)
    assert brightness(source) == [5, 15, 25, 35]
    np.testing.assert_allclose(source.times - source.times[0], times, rtol=0, atol=1e-6)
    assert (source.times[0] > 1e9) == (words == TAKEN)


@pytest.mark.parametrize(
    ("lines", "times"),
    [
        ([f"{round(x * 1e9)} {i}.png" for i, x in enumerate(SINCE_1970)], SECONDS),
        ([f"{round(x * 1e6)},{i}.png" for i, x in enumerate(SINCE_1970)], SECONDS),
        ([f"{x:.6f}" for x in SINCE_1970], SECONDS),
        ([f"2011-09-26 13:02:2{x}.951000064" for x in range(4)], [0.0, 1.0, 2.0, 3.0]),
    ],
)
def test_a_list_of_times_may_have_another_unit_and_no_names(tmp_path, calibration, lines, times):
    """KITTI's raw recordings have dates alone, beside a folder `data`."""
    write_pictures(tmp_path / "data", [f"{index}.png" for index in range(4)])
    listed(*lines)(tmp_path)
    source = open_source(tmp_path, calibration=calibration)
    assert brightness(source) == [5, 15, 25, 35]
    np.testing.assert_allclose(source.times - source.times[0], times, rtol=0, atol=2e-6)
    assert source.times[0] > 1e9


def test_times_of_a_list_since_a_camera_was_switched_on_have_a_unit(tmp_path, calibration):
    write_pictures(tmp_path / "images", ["0.png", "1.png"])
    listed("33000000 0.png", "66000000 1.png")(tmp_path)
    with pytest.warns(UserWarning, match=r"timestamps\.txt: times are taken as ns"):
        source = open_source(tmp_path, calibration=calibration)
    np.testing.assert_allclose(source.times, [0.033, 0.066], rtol=0, atol=1e-12)


def test_the_folder_of_a_camera_is_opened_and_one_above_pictures_names_it(tmp_path):
    path = euroc(tmp_path)
    whole, camera = open_source(path), open_source(path / "mav0" / "cam0")
    assert camera.calibration == whole.calibration
    np.testing.assert_array_equal(camera.times, whole.times)
    assert camera.reference is not None
    assert whole.reference is not None
    np.testing.assert_array_equal(camera.reference.T_wc, whole.reference.T_wc)
    write_pictures(tmp_path / "P001" / "image_left", ["0.png"])
    with pytest.raises(ValueError, match=r"\(pictures are in image_left: give one of these\), not"):
        open_source(tmp_path / "P001")


def test_a_calibration_of_the_folder_for_another_size_is_resized(tmp_path):
    path = timestamped(tmp_path)
    write_calibration(path / "calibration.json", Calibration(128, 96, 120.0, 120.0, 63.5, 47.5))
    with pytest.warns(UserWarning, match="calibration is for 128x96: it is taken to be of the sa"):
        source = open_source(path)
    assert source.calibration == Calibration(WIDTH, HEIGHT, 60.0, 60.0, 31.5, 23.5)


def deep(index, contrast, base=7000):
    """Grey levels of 16 bits, a ramp of this contrast above a level that drifts and jumps."""
    ramp = np.linspace(0, contrast, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)
    return (base + ramp + 400 * index - 900 * (index > 1)).astype(np.uint16)


@pytest.mark.parametrize("suffix", ["png", "tiff"])
def test_a_narrow_range_of_sixteen_bits_is_stretched_once_for_all(tmp_path, calibration, suffix):
    """As a thermal camera's, whose level drifts and jumps where it corrects itself."""
    for index in range(4):
        cv2.imwrite(str(tmp_path / f"{index}.{suffix}"), deep(index, 150))
    with pytest.warns(UserWarning, match="have more than 8 bits, of which 14.* grey levels are us"):
        frames = [frame.image for frame in open_source(tmp_path, calibration=calibration)]
    for image in frames:
        assert image.dtype == np.uint8
        np.testing.assert_allclose(image.ravel(), np.linspace(0, 255, image.size), rtol=0, atol=3)


def test_all_of_sixteen_bits_are_the_upper_eight(tmp_path, calibration):
    for index in range(2):
        cv2.imwrite(str(tmp_path / f"{index}.png"), deep(index, 60000, 2000))
    frames = [frame.image for frame in open_source(tmp_path, calibration=calibration)]
    for index, image in enumerate(frames):
        np.testing.assert_array_equal(image, deep(index, 60000, 2000) // 256)


def shaded(size=(HEIGHT, WIDTH)):
    return np.linspace(0, 255, size[0] * size[1]).reshape(size).astype(np.uint8)


@pytest.mark.parametrize("order", ["<", ">"])
def test_pictures_that_are_turned_alike_are_upright(tmp_path, order):
    for index in range(2):
        (tmp_path / f"{index}.jpg").write_bytes(jpeg(shaded(), 6, order))
    for frame in open_source(tmp_path, fov=60):
        upright = cv2.rotate(shaded(), cv2.ROTATE_90_CLOCKWISE)
        np.testing.assert_allclose(frame.image.astype(int), upright, rtol=0, atol=3)


def test_pictures_that_are_turned_differently_are_as_the_sensor_saw_them(tmp_path):
    for index, orientation in enumerate((1, 3, 6)):
        (tmp_path / f"{index}.jpg").write_bytes(jpeg(shaded(), orientation))
    cv2.imwrite(str(tmp_path / "3.jpg"), shaded())  # states none
    with pytest.warns(UserWarning, match=r"turned differently \(EXIF orientations \[1, 3, 6\]\)"):
        source = open_source(tmp_path, fov=60)
    for frame in source:
        np.testing.assert_allclose(frame.image.astype(int), shaded(), rtol=0, atol=3)
