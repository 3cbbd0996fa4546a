"""Data sets as they are published: times, images, lens and truth of each layout."""

import cv2
import numpy as np
import pytest
from pictures import HEIGHT, WIDTH, brightness, picture, write_pictures
from scipy.spatial.transform import Rotation

from jaxslam.io.calibration import Calibration, write_calibration
from jaxslam.io.opening import open_source


def pose(seed):
    draw = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(draw.normal(size=3)).as_matrix()
    T[:3, 3] = draw.normal(size=3)
    return T


def words(numbers):
    return " ".join(repr(float(x)) for x in np.ravel(numbers))


def tum_line(time, T):
    return f"{time} {words(T[:3, 3])} {words(Rotation.from_matrix(T[:3, :3]).as_quat())}"


@pytest.fixture
def tum_rgbd(tmp_path):
    path = tmp_path / "rgbd_dataset_freiburg2_desk"
    path.mkdir()
    names = ["rgb/5.25.png", "rgb/5.5.png"]
    for index, name in enumerate(names):
        (path / "rgb").mkdir(exist_ok=True)
        cv2.imwrite(str(path / name), np.full((480, 640), 10 * index + 5, np.uint8))
    (path / "rgb.txt").write_text(f"# color images\n5.25 {names[0]}\n5.5 {names[1]}\n")
    (path / "groundtruth.txt").write_text("# t\n" + tum_line(5.3, pose(0)) + "\n")
    return path


@pytest.mark.parametrize(
    ("name", "pinhole", "distortion"),
    [
        ("fr1_xyz", (517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
        ("freiburg2", (520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
        ("freiburg3_office", (535.4, 539.2, 320.1, 247.6), ()),
    ],
)
def test_tum_rgbd_has_the_lens_of_its_kinect(tum_rgbd, name, pinhole, distortion):
    """As the benchmark's page has them, in pixels."""
    source = open_source(tum_rgbd.rename(tum_rgbd.with_name(name)))
    assert brightness(source) == [5, 15]
    assert source.times.tolist() == [5.25, 5.5]
    assert source.calibration == Calibration(640, 480, *pinhole, distortion)
    assert source.reference is not None
    assert source.reference.times.tolist() == [5.3]
    np.testing.assert_allclose(source.reference.T_wc[0], pose(0), atol=1e-12)


def test_a_calibration_in_the_folder_is_better_than_the_layouts_own(tum_rgbd):
    write_calibration(tum_rgbd / "calibration.json", Calibration(640, 480, 500.0, 500.0, 320, 240))
    assert open_source(tum_rgbd).calibration.fx == 500.0


def test_a_tum_folder_of_another_name_has_no_lens(tum_rgbd):
    other = tum_rgbd.rename(tum_rgbd.with_name("mine"))
    with pytest.warns(UserWarning, match="has no calibration"):
        assert open_source(other).calibration.guessed


SENSOR = """#Default parameters
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [{data}]
rate_hz: 20
resolution: [{width}, {height}]
camera_model: pinhole
intrinsics: [60.5, 61.5, 31.0, 23.0] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 1.7e-05]
"""


@pytest.fixture
def euroc(tmp_path):
    """Two frames at 20 Hz, with carriage returns as published; the body's truth is `pose(1)`."""
    path = tmp_path / "MH_01_easy"
    camera, truth = path / "mav0" / "cam0", path / "mav0" / "state_groundtruth_estimate0"
    truth.mkdir(parents=True)
    times = [1403636579763555584, 1403636579813555456]
    write_pictures(camera / "data", [f"{time}.png" for time in times])
    (camera / "data.csv").write_text(
        "#timestamp [ns],filename\r\n" + "".join(f"{t},{t}.png\r\n" for t in times)
    )
    data = words(pose(2)).replace(" ", ",\n   ")
    (camera / "sensor.yaml").write_text(SENSOR.format(data=data, width=WIDTH, height=HEIGHT))
    body = pose(1)
    x, y, z, w = Rotation.from_matrix(body[:3, :3]).as_quat()
    row = [*body[:3, 3], w, x, y, z, 0.1, 0.2, 0.3]
    (truth / "data.csv").write_text(
        "#timestamp, p_RS_R_x [m]\r\n"
        + "".join(f"{t}," + ",".join(repr(float(v)) for v in row) + "\r\n" for t in times)
    )
    return path


@pytest.mark.parametrize("inside", ["", "mav0"])
def test_euroc_gives_the_truth_of_the_camera_not_of_the_body(euroc, inside):
    source = open_source(euroc / inside)
    assert brightness(source) == [5, 15]
    # Doubles of such seconds are 2.4e-7 s apart.
    assert source.times[1] - source.times[0] == pytest.approx(0.05, abs=5e-7)
    assert source.times[0] == pytest.approx(1403636579.763555584, abs=5e-7)
    c = source.calibration
    assert (c.width, c.height, c.fx, c.fy, c.cx, c.cy) == (WIDTH, HEIGHT, 60.5, 61.5, 31.0, 23.0)
    assert c.distortion == (-0.28, 0.07, 0.0002, 1.7e-05, 0.0)
    assert source.reference is not None
    assert source.reference.times.tolist() == source.times.tolist()
    np.testing.assert_allclose(source.reference.T_wc[0], pose(1) @ pose(2), atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("radial-tangential", "equidistant", "unknown distortion_model 'equidistant'"),
        ("61.5, ", "", r"sensor\.yaml: intrinsics: \[4 finite numbers\] is missing"),
        ("60.5", "nan", r"intrinsics: \[4 finite numbers\] is missing"),
        ("60.5", "-60.5", r"sensor\.yaml: fx must be positive, not -60\.5"),
    ],
)
def test_a_camera_of_euroc_that_is_not_known_is_refused(euroc, old, new, message):
    yaml = euroc / "mav0" / "cam0" / "sensor.yaml"
    yaml.write_text(yaml.read_text().replace(old, new))
    with pytest.raises(ValueError, match=message):
        open_source(euroc)


def projection(shift):
    return np.array([[70.0, 0, 30, 70.0 * shift], [0, 71.0, 20, 0], [0, 0, 1, 0]])


@pytest.fixture
def kitti(tmp_path):
    """Three frames; image_2's camera is 0.06 m to the left of the grey one."""
    path = tmp_path / "sequences" / "06"
    for camera in "02":
        write_pictures(path / f"image_{camera}", [f"{i:06d}.png" for i in range(3)])
    (path / "times.txt").write_text("0.0e+00\n1.04e-01\n2.07e-01\n")
    (path / "calib.txt").write_text(
        f"P0: {words(projection(0.0))}\nP1: {words(projection(-0.5))}\n"
        f"P2: {words(projection(0.06))}\n"
    )
    (tmp_path / "poses").mkdir()
    (tmp_path / "poses" / "06.txt").write_text("".join(words(pose(i)[:3]) + "\n" for i in range(3)))
    return path


def test_kitti_gives_the_left_grey_camera(kitti):
    source = open_source(kitti)
    assert brightness(source) == [5, 15, 25]
    assert source.times.tolist() == [0.0, 0.104, 0.207]
    c = source.calibration
    assert (c.width, c.height, c.fx, c.fy, c.cx, c.cy) == (WIDTH, HEIGHT, 70, 71, 30, 20)
    assert source.reference is not None
    np.testing.assert_allclose(source.reference.T_wc, [pose(i) for i in range(3)], atol=1e-12)


def test_kitti_without_grey_images_gives_the_colour_camera_where_it_is(kitti):
    (kitti / "image_0").rename(kitti / "unused")
    reference = open_source(kitti).reference
    assert reference is not None
    left = np.eye(4)
    left[0, 3] = -0.06
    np.testing.assert_allclose(reference.T_wc, [pose(i) @ left for i in range(3)], atol=1e-12)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("times.txt", "0\n0.1\n", r"times\.txt has 2 lines for 3 images"),
        ("times.txt", "0\n0.1\n0.1\n", r"times\.txt, line 3: time 0\.1 s does not come after"),
        ("times.txt", "0\nx\n0.1\n", r"times\.txt, line 2: expected finite times in seconds"),
        ("calib.txt", "P1: 1 2 3\n", r"calib\.txt has no line P0:"),
        ("calib.txt", "P0: 1 2 3\n", r"calib\.txt, line 1: expected P0: and twelve numbers"),
        ("poses.txt", "1 0 0 0 0 1 0 0 0 0 1\n", r"poses\.txt, line 1: expected 12 finite numbers"),
        ("poses.txt", words(np.eye(4)[:3]) + "\n", r"poses\.txt has 1 lines for 3 images"),
    ],
)
def test_a_file_of_kitti_that_does_not_fit_is_named(kitti, file, text, message):
    (kitti / file).write_text(text)
    with pytest.raises(ValueError, match=message):
        open_source(kitti)


@pytest.fixture
def seven_scenes(tmp_path):
    """Frames 0, 1 and 3; the pose of frame 1 is not finite."""
    path = tmp_path / "seq-01"
    path.mkdir()
    for index in (0, 1, 3):
        image = np.full((480, 640), 10 * index + 5, np.uint8)
        cv2.imwrite(str(path / f"frame-{index:06d}.color.png"), image)
        matrix = np.full((4, 4), np.nan) if index == 1 else pose(index)
        text = "\n".join("\t".join(repr(float(x)) for x in row) for row in matrix)
        (path / f"frame-{index:06d}.pose.txt").write_text(text + "\n")
    return path


def test_seven_scenes_has_a_pose_beside_each_picture(seven_scenes):
    source = open_source(seven_scenes)
    assert brightness(source) == [5, 15, 35]
    np.testing.assert_allclose(source.times, [0, 1 / 30, 3 / 30], rtol=0, atol=1e-12)
    assert source.calibration == Calibration(640, 480, 585.0, 585.0, 320.0, 240.0)
    assert source.reference is not None
    np.testing.assert_allclose(source.reference.times, [0, 3 / 30], rtol=0, atol=1e-12)
    np.testing.assert_allclose(source.reference.T_wc, [pose(0), pose(3)], rtol=0, atol=1e-12)


def test_a_picture_of_seven_scenes_may_lack_its_pose(seven_scenes):
    (seven_scenes / "frame-000000.pose.txt").unlink()
    reference = open_source(seven_scenes).reference
    assert reference is not None
    np.testing.assert_allclose(reference.times, [3 / 30], rtol=0, atol=1e-12)


def test_a_pose_of_seven_scenes_that_is_no_matrix_is_named(seven_scenes):
    (seven_scenes / "frame-000003.pose.txt").write_text("1 0 0 0\n")
    with pytest.raises(ValueError, match=r"frame-000003\.pose\.txt has 1 rows; expected a 4x4"):
        open_source(seven_scenes)


def test_a_picture_that_a_list_names_and_nobody_has_is_named(euroc):
    next((euroc / "mav0" / "cam0" / "data").iterdir()).unlink()
    with pytest.raises(ValueError, match=r"data\.csv names \d+\.png, but .* is missing"):
        open_source(euroc)


def test_a_broken_picture_is_named_when_it_is_reached(kitti):
    (kitti / "image_0" / "000001.png").write_bytes(b"no picture")
    frames = iter(open_source(kitti))
    assert np.array_equal(next(frames).image, picture(0))
    with pytest.raises(ValueError, match=r"000001\.png: cannot be read as an image"):
        next(frames)
