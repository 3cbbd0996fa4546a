"""Pictures in bags of ROS: every encoding, the lens beside them, and bags that are damaged."""

from functools import partial

import cv2
import numpy as np
import pytest
import refusals
from bags import ros_of, write_bag
from pictures import HEIGHT, WIDTH, brightness, picture
from videos import LENS, STAMPS

from jaxslam.cli.track import TrackOptions
from jaxslam.io import ros_images
from jaxslam.io.calibration import Calibration
from jaxslam.io.opening import open_source

SIZE = HEIGHT, WIDTH
TOPIC = "/camera/image_raw"


def pictures(r, stamps=STAMPS):
    return [r.image(t, picture(i), "mono8") for i, t in enumerate(stamps)]


def info(r, **how):
    given = {"size": SIZE, "K": LENS.matrix, "D": LENS.distortion} | how
    return [r.camera_info(STAMPS[0], **given)]


def film(path, **more):
    """With a lens beside the pictures."""
    r = ros_of(path)
    return write_bag(path, {TOPIC: pictures(r), "/camera/camera_info": info(r)} | more)


def test_pictures_are_read_as_they_are_asked_for(tmp_path, monkeypatch):
    bag, read, as_image = film(tmp_path / "run.mcap"), [], ros_images.as_image

    def counted(place, message):
        read.append(place)
        return as_image(place, message)

    monkeypatch.setattr(ros_images, "as_image", counted)
    source = open_source(bag)
    assert len(read) == 1  # which tells the size
    frames = iter(source)
    next(frames)
    assert len(read) == 2
    named = TrackOptions(source=bag, topic="camera/image_raw")._source()
    assert named.name == source.name == f"{bag}:{TOPIC}"


COLOUR = {"r": 200, "g": 100, "b": 30}
LUMA = round(0.299 * 200 + 0.587 * 100 + 0.114 * 30)


def colour(order):
    return np.tile(np.array([COLOUR.get(x, 255) for x in order], np.uint8), (*SIZE, 1))


def mosaic(pattern):
    tile = np.array([COLOUR[x] for x in pattern], np.uint8).reshape(2, 2)
    return np.tile(tile, (HEIGHT // 2, WIDTH // 2))


@pytest.mark.parametrize(
    ("encoding", "data", "big"),
    [
        ("mono8", np.full(SIZE, LUMA, np.uint8), 0),
        ("8UC1", np.full(SIZE, LUMA, np.uint8), 0),
        ("mono16", np.full(SIZE, 256 * LUMA + 77, "<u2"), 0),
        ("mono16", np.full(SIZE, 256 * LUMA + 77, ">u2"), 1),
        ("rgb8", colour("rgb"), 0),
        ("bgr8", colour("bgr"), 0),
        ("8UC3", colour("bgr"), 0),
        ("rgba8", colour("rgba"), 0),
        ("bgra8", colour("bgra"), 0),
        *[(f"bayer_{x}8", mosaic(x), 0) for x in ("rggb", "bggr", "gbrg", "grbg")],
        ("bayer_rggb16", mosaic("rggb") * np.uint16(256), 0),
        ("16UC1", np.full(SIZE, 256 * LUMA + 77, "<u2"), 0),
        ("8UC4", colour("bgra"), 0),
        *[(x, np.tile(np.array([128, LUMA], np.uint8), SIZE), 0) for x in ("yuv422", "uyvy")],
        *[(x, np.tile(np.array([LUMA, 128], np.uint8), SIZE), 0) for x in ("yuv422_yuy2", "yuyv")],
        ("nv12", np.full(SIZE, LUMA, np.uint8), 0),
    ],
)
def test_every_encoding_is_made_grey(encoding, data, big, tmp_path):
    for name, spare in (("run.bag", 0), ("run.mcap", 6)):
        step = data.nbytes // HEIGHT + spare
        told = [ros_of(name).image(STAMPS[0], data, encoding, step=step, big=big, width=WIDTH)]
        (frame,) = open_source(write_bag(tmp_path / name, {TOPIC: told}), fov=60)
        assert (frame.image.shape, frame.image.dtype) == (SIZE, np.uint8)
        np.testing.assert_allclose(frame.image, LUMA, rtol=0, atol=1)


def test_a_mosaic_that_is_compressed_is_made_grey(tmp_path):
    r, data = ros_of("run.bag"), cv2.imencode(".png", mosaic("rggb"))[1]
    for form, grey in (("bayer_rggb8; png compressed ", LUMA), ("mono8; png compressed ", 200)):
        told = {f"{TOPIC}/compressed": [r.compressed(STAMPS[0], data, form)]}
        (frame,) = open_source(write_bag(tmp_path / f"{form[:4]}.bag", told), fov=60)
        assert abs(int(frame.image[0, 0]) - grey) <= 1


def test_a_thermal_topic_is_stretched_once_for_all(tmp_path):
    r, ramp = ros_of("run.mcap"), np.linspace(0, 300, WIDTH * HEIGHT).reshape(SIZE)
    levels = [(7000 + 200 * i + ramp).astype("<u2") for i in range(4)]
    told = {TOPIC: [r.image(t, x, "mono16") for t, x in zip(STAMPS, levels, strict=True)]}
    with pytest.warns(UserWarning, match="image_raw: pictures have more than 8 bits, of which 29"):
        frames = list(open_source(write_bag(tmp_path / "run.mcap", told), fov=60))
    for frame in frames:
        assert np.abs(frame.image.ravel() - np.linspace(0, 255, ramp.size)).max() < 3


@pytest.mark.parametrize(
    ("size", "part", "expected"),
    [
        ((200, 300), (10, 20, WIDTH, HEIGHT, 1, 1), (60.0, 61.0, 21.0, 3.0)),
        ((200, 300), (10, 3, 2 * WIDTH, 2 * HEIGHT, 2, 2), (30.0, 30.5, 10.25, 9.75)),
        ((2 * HEIGHT, 2 * WIDTH), (0, 0, 0, 0, 2, 2), (30.0, 30.5, 15.25, 11.25)),
        (SIZE, (0, 0, WIDTH, HEIGHT, 0, 0), (60.0, 61.0, 31.0, 23.0)),
    ],
)
def test_a_part_of_the_sensor_has_its_own_centre(tmp_path, size, part, expected):
    for name in ("run.bag", "run.mcap"):
        r = ros_of(name)
        told = {"/camera/camera_info": info(r, size=size, part=part)}
        found = open_source(film(tmp_path / name, **told)).calibration
        assert (found.fx, found.fy, found.cx, found.cy) == expected


def test_compressed_and_rectified_pictures_have_the_lens_of_their_camera(tmp_path):
    r = ros_of("run.bag")
    for form in (".jpg", ".png"):
        data = cv2.imencode(form, np.ascontiguousarray(colour("bgr")))[1]
        told = {f"{TOPIC}/compressed": [r.compressed(STAMPS[0], data)]}
        bag = write_bag(tmp_path / f"{form}.bag", told | {"/camera/camera_info": info(r)})
        (frame,) = source = open_source(bag)
        np.testing.assert_allclose(frame.image, LUMA, rtol=0, atol=2)
        assert source.calibration.fx == 60
    P = [[50, 0, 30, 0], [0, 50, 20, 0], [0, 0, 1, 0]]
    topics = {"/camera/image_rect": pictures(r), "/camera/camera_info": info(r, P=P, model="equid")}
    bag = write_bag(tmp_path / "run.bag", topics)
    assert open_source(bag).calibration == Calibration(WIDTH, HEIGHT, 50.0, 50.0, 30.0, 20.0)


def test_without_a_lens_it_is_guessed(tmp_path):
    r = ros_of("run.mcap")
    zero = info(r, K=np.zeros((3, 3)), D=(), model="")
    for name, beside in (
        ("none.mcap", {}),
        ("zero.mcap", {"/camera/camera_info": zero}),
        ("other.mcap", {"/left/camera_info": info(r)}),
        ("rect.mcap", {"/camera/camera_info": info(r)}),  # whose P is zero
    ):
        topic = "/camera/image_rect" if name == "rect.mcap" else TOPIC
        bag = write_bag(tmp_path / name, {topic: pictures(r)} | beside)
        with pytest.warns(UserWarning, match=f"{name}:{topic} has no calibration"):
            assert open_source(bag).calibration.guessed
    bag = write_bag(tmp_path / "bare.mcap", {"image_raw": pictures(r), "camera_info": info(r)})
    assert open_source(bag).calibration.fx == 60


refused = partial(refusals.refused, lambda *given, **more: list(open_source(*given, **more)))


def test_another_lens_is_refused_unless_a_calibration_is_given(tmp_path, calibration):
    r = ros_of("run.bag")
    bag = film(tmp_path / "run.bag", **{"/camera/camera_info": info(r, model="omni")})
    refused("run.bag:/camera/camera_info: unknown lens, omni of 5 numbers", bag)
    assert len(list(open_source(bag, calibration=calibration))) == 4
    told = info(r, K=np.diag([-1.0, 1, 1]))
    bag = film(tmp_path / "k.bag", **{"/camera/camera_info": told})
    refused("k.bag:/camera/camera_info: fx must be positive, not -1.0", bag)


def test_topics_of_pictures_are_listed(tmp_path):
    r = ros_of("run.bag")
    bag = film(tmp_path / "run.bag", **{"/right/image_raw": pictures(r)})
    refused(r"2 topics fit --topic; name one .* /camera/image_raw \(sensor_msgs/Image, 4 m", bag)
    refused(r"no topics fit --topic /x; .*/camera/camera_info \(sensor", f"{bag}:/x")
    assert brightness(open_source(f"{bag}:/right/image_raw", fov=60)) == [5, 15, 25, 35]
    empty = write_bag(tmp_path / "no.mcap", {}, empty=[("/i", "sensor_msgs/Image")])
    refused(r"no\.mcap: no topics fit .* are /i \(sensor_msgs/Image, 0 messages\)", empty)
    refused("x.mp4:/x: no such file", tmp_path / "x.mp4:/x")


def one(data, encoding, **how):
    return lambda r: [r.image(STAMPS[0], data, encoding, **how)]


def compressed(count):
    return lambda r: [r.compressed(STAMPS[0], np.zeros(count, np.uint8))]


@pytest.mark.parametrize(
    ("told", "message"),
    [
        (one(np.zeros(SIZE, "f4"), "32FC1"), "message 0: unknown encoding '32FC1'; known: mo"),
        (one(picture(0), "bgr8", width=WIDTH),
         "message 0: 3072 bytes in rows of 64 are not a complete 64x48 picture in bgr8"),
        (one(picture(0)[:, :0], "mono8"), "0 bytes in rows of 0 are not a complete 0x48 picture"),
        (compressed(9), "message 0: cannot be read as an image"),
        (compressed(0), "message 0: cannot be read as an image"),
        (lambda r: pictures(r, STAMPS[::-1]), "message 1: time .* does not come after"),
        (lambda r: pictures(r, 0 * STAMPS), "message 1: time 0.0* s does not come after"),
        (lambda r: [*pictures(r), r.image(STAMPS[-1] + 1, picture(0)[:10], "mono8")],
         "image 4 is 64x10, but the calibration is for 64x48"),
    ],
)  # fmt: skip
def test_bad_pictures_are_refused_in_one_line(told, message, tmp_path):
    bag = write_bag(tmp_path / "run.bag", {TOPIC: told(ros_of("run.bag"))})
    refused(message, bag, fov=60)
