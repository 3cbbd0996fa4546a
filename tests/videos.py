"""Videos that tests write: data sets as they are published, and bags of ROS."""

import cv2
import numpy as np
from bags import EPOCH, ros_of, write_bag
from pictures import HEIGHT, WIDTH, picture, write_pictures
from scipy.spatial.transform import Rotation

from jaxslam.io.calibration import Calibration, write_calibration
from jaxslam.io.tum import write_tum

OWN = Calibration(WIDTH, HEIGHT, 60.0, 60.0, 31.5, 23.5)


def pose(seed):
    draw = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(draw.normal(size=3)).as_matrix()
    T[:3, 3] = draw.normal(size=3)
    return T


def words(numbers, between=" "):
    return between.join(repr(float(x)) for x in np.ravel(numbers))


def write_large(folder, names):
    """Pictures of 640 × 480, as two data sets have them."""
    for index, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / name), np.full((480, 640), 10 * index + 5, np.uint8))


def timestamped(folder):
    """Pictures that the list leaves out, and a calibration beside it."""
    write_pictures(folder / "images", [f"{index}.png" for index in (0, 1, 9, 3)])
    (folder / "timestamps.txt").write_text("# seconds file\n0.5 0.png\n0.6 1.png\n0.75 3.png\n")
    write_calibration(folder / "calibration.json", OWN)
    write_tum(folder / "groundtruth.txt", [0.5, 0.6], [pose(0), pose(1)])
    return folder


def plain(folder):
    """Pictures whose numbers have no leading zeros, and something else."""
    write_pictures(folder, [f"frame{index}.png" for index in range(1, 12)])
    (folder / "notes.md").write_text("not an image")
    return folder


def tum_rgbd(folder):
    path = folder / "rgbd_dataset_freiburg2_desk"
    write_large(path, ["rgb/5.25.png", "rgb/5.5.png"])
    (path / "rgb.txt").write_text("# color images\n5.25 rgb/5.25.png\n5.5 rgb/5.5.png\n")
    truth = words(pose(0)[:3, 3]), words(Rotation.from_matrix(pose(0)[:3, :3]).as_quat())
    (path / "groundtruth.txt").write_text(f"# t\n5.3 {' '.join(truth)}\n")
    return path


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
NANOSECONDS = 1403636579763555584, 1403636579813555456


def euroc(folder):
    """Two frames at 20 Hz, with carriage returns as published; the body's truth is `pose(1)`."""
    path = folder / "MH_01_easy"
    camera, truth = path / "mav0" / "cam0", path / "mav0" / "state_groundtruth_estimate0"
    truth.mkdir(parents=True)
    write_pictures(camera / "data", [f"{time}.png" for time in NANOSECONDS])
    rows = "".join(f"{t},{t}.png\r\n" for t in NANOSECONDS)
    (camera / "data.csv").write_text(f"#timestamp [ns],filename\r\n{rows}")
    data = words(pose(2), ",\n   ")
    (camera / "sensor.yaml").write_text(SENSOR.format(data=data, width=WIDTH, height=HEIGHT))
    x, y, z, w = Rotation.from_matrix(pose(1)[:3, :3]).as_quat()
    row = words([*pose(1)[:3, 3], w, x, y, z, 0.1, 0.2, 0.3], ",")
    rows = "".join(f"{t},{row}\r\n" for t in NANOSECONDS)
    (truth / "data.csv").write_text(f"#timestamp, p_RS_R_x [m]\r\n{rows}")
    return path


def projection(shift):
    return words([[70.0, 0, 30, 70.0 * shift], [0, 71.0, 20, 0], [0, 0, 1, 0]])


def kitti(folder):
    """Three frames; image_2's camera is 0.06 m to the left of the grey one."""
    path = folder / "sequences" / "06"
    for camera in "02":
        write_pictures(path / f"image_{camera}", [f"{i:06d}.png" for i in range(3)])
    (path / "times.txt").write_text("0.0e+00\n1.04e-01\n2.07e-01\n")
    lenses = [f"P{i}: {projection(shift)}\n" for i, shift in enumerate((0.0, -0.5, 0.06))]
    (path / "calib.txt").write_text("".join(lenses))
    (folder / "poses").mkdir()
    (folder / "poses" / "06.txt").write_text("".join(words(pose(i)[:3]) + "\n" for i in range(3)))
    return path


def kitti_in_colour(folder):
    path = kitti(folder)
    (path / "image_0").rename(path / "unused")
    return path


def seven_scenes(folder):
    """Frames 0, 1 and 3; the pose of frame 1 is not finite."""
    path = folder / "seq-01"
    write_large(path, [f"frame-{i:06d}.color.png" for i in (0, 1, 3)])
    for i in (0, 1, 3):
        rows = np.full((4, 4), np.nan) if i == 1 else pose(i)
        text = "\n".join(words(row, "\t") for row in rows)
        (path / f"frame-{i:06d}.pose.txt").write_text(f"{text}\n")
    return path


LENS = Calibration(WIDTH, HEIGHT, 60.0, 61.0, 31.0, 23.0, (-0.1, 0.02, 0.001, -0.002, 0.003))
STAMPS = EPOCH + np.array([0.0, 0.1, 0.25, 0.3])


def bag(name):
    def write(folder):
        r = ros_of(name)
        images = [r.image(t, picture(i), "mono8") for i, t in enumerate(STAMPS)]
        K = [60.0, 0, 31, 0, 61, 23, 0, 0, 1]
        info = r.camera_info(STAMPS[0], (HEIGHT, WIDTH), K, LENS.distortion)
        topics = {"/camera/image_raw": images, "/camera/camera_info": [info]}
        return write_bag(folder / name, topics)

    return write
