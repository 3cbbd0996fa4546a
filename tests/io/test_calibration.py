"""The calibration file: what is read back, and what is refused with which words."""

import json
from dataclasses import replace

import numpy as np
import pytest
from refusals import refused

from jaxslam.io.calibration import Calibration, from_field_of_view, write_calibration
from jaxslam.io.lens_files import read_calibration

PINHOLE = {"model": "pinhole", "width": 640, "height": 480}
GOOD = PINHOLE | {"fx": 525.0, "fy": 524.0, "cx": 308.5, "cy": 236.5, "distortion": [0.1, -0.2]}
SIGMAS = dict.fromkeys(("fx", "fy", "cx", "cy"), 1.0)
PLAIN = Calibration(640, 480, 525.06, 524.2, 308.6, 236.5)


@pytest.mark.parametrize(
    "calibration",
    [
        PLAIN,
        replace(PLAIN, distortion=(0.1, -0.2, 1e-4, 2e-4, 0.3), sigma=(1.5, 1.6, 0.7, 0.8)),
        from_field_of_view(640, 480),
    ],
    ids=["plain", "with σ", "guessed"],
)
def test_a_calibration_is_read_back_and_what_was_not_stated_is_not_written(calibration, tmp_path):
    path = tmp_path / "c.json"
    write_calibration(path, calibration)
    assert read_calibration(path) == calibration
    assert list(tmp_path.iterdir()) == [path]
    assert calibration is not PLAIN or json.loads(path.read_text()).keys() == GOOD.keys()
    if any(calibration.sigma):  # with what is known besides
        write_calibration(path, calibration, sigma={"distortion": [0.1] * 5}, views=12)
        assert read_calibration(path) == calibration
        written = json.loads(path.read_text())
        assert (written["sigma"]["fx"], written["views"]) == (calibration.sigma[0], 12)
        assert written["sigma"]["distortion"] == [0.1] * 5


def test_a_field_of_view_reaches_from_edge_to_edge():
    calibration = from_field_of_view(640, 480, 80.0)
    assert calibration.guessed
    across = np.degrees(np.arctan(320 / calibration.fx)) * 2
    assert across == pytest.approx(80.0, rel=1e-12)
    assert calibration.fx == calibration.fy
    assert (calibration.cx, calibration.cy) == (319.5, 239.5)
    assert calibration.sigma[:2] == (0.05 * calibration.fx,) * 2
    # A guess is of the longer side, and less sure.
    wide, tall = from_field_of_view(640, 480), from_field_of_view(480, 640)
    assert wide.fx == tall.fx == pytest.approx(320 / np.tan(np.radians(65 / 2)), rel=1e-12)
    assert wide.sigma[::2] == pytest.approx((0.15 * wide.fx, 0.02 * 640), rel=1e-12)
    for degrees in (0.0, 180.0, float("nan")):
        with pytest.raises(ValueError, match="between 0° and 180°"):
            from_field_of_view(640, 480, degrees)


def test_resized_keeps_directions_and_the_share_of_every_error():
    old = Calibration(640, 480, 525.0, 524.0, 308.5, 236.5, (0.1,), sigma=(1.0, 2.0, 3.0, 4.0))
    new = old.resized(320, 120)
    # The picture's corner (-1/2, -1/2) stays its corner.
    ray = np.linalg.solve(old.matrix, [-0.5, -0.5, 1.0])
    np.testing.assert_allclose((new.matrix @ ray)[:2], [-0.5, -0.5], rtol=0, atol=1e-12)
    ray = np.linalg.solve(old.matrix, [639.5, 479.5, 1.0])
    np.testing.assert_allclose((new.matrix @ ray)[:2], [319.5, 119.5], rtol=0, atol=1e-12)
    assert new.sigma == (0.5, 0.5, 1.5, 1.0)
    assert new.distortion == old.distortion


LENS = Calibration(640, 480, 525.0, 524.0, 308.5, 236.5, (0.1, -0.2, 0.01, 0.02))
FOLDED = "[525.0, 0.,\n     308.5, 0., 524.0, 236.5, 0., 0., 1.]"
K = "[525.0, 0, 308.5, 0, 524.0, 236.5, 0, 0, 1]"
OTHERS = {
    "opencv.yaml": f"""%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: {FOLDED}
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   data: [ 0.1, -0.2, 0.01, 0.02, 0. ]
""",
    "ros.yaml": f"""image_width: 640
image_height: 480
camera_name: cam  # and what it is for
camera_matrix:
  data: {K}
distortion_model: plumb_bob
distortion_coefficients:
  data: [0.1, -0.2, 0.01, 0.02, 0]
""",
    "camchain.yaml": """cam0:
  camera_model: pinhole
  distortion_coeffs: [0.1, -0.2, 0.01, 0.02]
  distortion_model: radtan
  intrinsics: [525.0, 524.0, 308.5, 236.5]
  resolution: [640, 480]
cam1:
  intrinsics: [1.0, 1.0, 1.0, 1.0]
""",
    "orb.yaml": """%YAML:1.0
Camera.type: "PinHole"
Camera.fx: 525.0
Camera.fy: 524.0
Camera.cx: 308.5
Camera.cy: 236.5
Camera.k1: 0.1
Camera.k2: -0.2
Camera.p1: 0.01
Camera.p2: 0.02
Camera.width: 640
Camera.height: 480
""",
    "cameras.txt": "# CAMERA_ID\n1 OPENCV 640 480 525 524 309.0 237.0 0.1 -0.2 0.01 0.02\n",
    "other.json": """{"image_width": 640, "image_height": 480,
 "dist_coeff": [[0.1, -0.2, 0.01, 0.02]],
 "camera_matrix": [[525.0, 0, 308.5], [0, 524.0, 236.5], [0, 0, 1]]}""",
}


FISHEYE = replace(LENS, distortion=(0.1, -0.2, 0.01, 0.02), model="fisheye")
RATIONAL = replace(LENS, distortion=(0.1, -0.2, 0.01, 0.02, 0.0, 0.0, 0.0, 0.3), model="rational")
EIGHT = "0.02, 0, 0, 0, 0.3]"
FOUR = replace(LENS, fy=525.0, distortion=(0.1, -0.2))


COLMAP = "OPENCV 640 480 525 524 309.0 237.0 0.1 -0.2 0.01 0.02"


@pytest.mark.parametrize(
    ("name", "old", "new", "lens"),
    [
        *[(name, "", "", LENS) for name in OTHERS],
        ("camchain.yaml", "radtan", "equidistant", FISHEYE),
        ("camchain.yaml", "model: pinhole", "model: pinhole-equi", FISHEYE),
        ("ros.yaml", "plumb_bob", "kannala_brandt", FISHEYE),
        ("opencv.yaml", "---\n", "---\nfisheye_model: 1\n", FISHEYE),
        ("cameras.txt", "OPENCV", "OPENCV_FISHEYE", FISHEYE),
        ("orb.yaml", '"PinHole"', '"KannalaBrandt8"', FISHEYE),
        ("ros.yaml", "0.02, 0]", EIGHT, RATIONAL),
        ("opencv.yaml", "0.02, 0. ]", EIGHT, RATIONAL),
        ("cameras.txt", "OPENCV", "FULL_OPENCV", RATIONAL),
        *[
            ("cameras.txt", COLMAP, f"{model} 640 480 {values}", lens)
            for model, values, lens in (
                ("SIMPLE_PINHOLE", "525 309 237", replace(LENS, fy=525.0, distortion=())),
                ("PINHOLE", "525 524 309 237", replace(LENS, distortion=())),
                ("SIMPLE_RADIAL", "525 309 237 0.1", replace(LENS, fy=525.0, distortion=(0.1,))),
                ("RADIAL", "525 309 237 .1 -.2", FOUR),
                (
                    "RADIAL_FISHEYE",
                    "525 309 237 .1 -.2",
                    replace(FISHEYE, fy=525.0, distortion=FOUR.distortion[:2]),
                ),
            )
        ],
    ],
)
def test_the_lenses_of_other_programs_are_read(tmp_path, name, old, new, lens):
    text = OTHERS[name].replace(old, new) if old else OTHERS[name]
    if lens == FISHEYE and name == "orb.yaml":
        text = text.replace("p1", "k3").replace("p2", "k4")
    if lens is RATIONAL:
        text = text.replace("plumb_bob", "rational_polynomial")
        text = text.replace("0.01 0.02\n", "0.01 0.02 0 0 0 0.3\n")
    (tmp_path / name).write_text(text)
    assert read_calibration(tmp_path / name) == lens
    write_calibration(tmp_path / "own.json", lens)
    assert read_calibration(tmp_path / "own.json") == lens


NAMED = "fx: 525.0\nfy: 524.0\ncx: 308.5\ncy: 236.5\n"
BENT = "k1: 0.1\nk2: -0.2\np1: 0.01\np2: 0.02\n"
OF_FOUR = "k1: 0.1\nk2: -0.2\nk3: 0.01\nk4: 0.02\n"
SIZE = "Camera.width: 640\nCamera.height: 480\n"
NUMBERS = {"fx": 525.0, "fy": 524.0, "cx": 308.5, "cy": 236.5}
WIDTH_HEIGHT = {"width": 640, "height": 480}
FOUR_NUMBERS = [0.1, -0.2, 0.01, 0.02]
ROWS = [[525.0, 0, 308.5], [0, 524.0, 236.5], [0, 0, 1]]
COLUMNS = [list(column) for column in zip(*ROWS, strict=True)]


def below(name, *lines, indent="  "):
    """Lines of YAML below a key, or with the key before each of them."""
    if name.endswith("."):
        return "".join(name + line + "\n" for text in lines for line in text.splitlines())
    return f"{name}:\n" + "".join(indent + x + "\n" for text in lines for x in text.splitlines())


def block(numbers):
    return "".join(f"- {x}\n" for x in np.ravel(numbers).tolist())


VINS = "image_width: 640\nimage_height: 480\n"
KANNALA = "k2: 0.1\nk3: -0.2\nk4: 0.01\nk5: 0.02\nmu: 525.0\nmv: 524.0\nu0: 308.5\nv0: 236.5\n"
ROS_2 = f"height: 480\nwidth: 640\ndistortion_model: plumb_bob\nd:\n{block(FOUR_NUMBERS)}k:\n"
WHOLE = "height: 960\nwidth: 1280\nD: [0.1, -0.2, 0.01, 0.02]\n"
SVO = below("distortion", "parameters:\n  data: [0.1, -0.2, 0.01, 0.02]", "type: TYPE")
SVO += f"image_height: 480\nimage_width: 640\nintrinsics:\n  data: {list(NUMBERS.values())}\n"
XML = """<?xml version="1.0"?><opencv_storage><image_width>640</image_width>
<image_height>480</image_height><camera_matrix type_id="opencv-matrix"><rows>3</rows><data>
525. 0. 308.5 0. 524.
236.5 0. 0. 1.</data></camera_matrix><distortion_coefficients><data>0.1 -0.2 0.01 0.02 0.</data>
</distortion_coefficients></opencv_storage>"""
BASALT = {"camera_type": "kb4", "intrinsics": NUMBERS | dict(k1=0.1, k2=-0.2, k3=0.01, k4=0.02)}
NERF = {"fl_x": 525.0, "fl_y": 524.0, "cx": 309.0, "cy": 237.0, "w": 640, "h": 480, "k1": 0.1}
REALSENSE = WIDTH_HEIGHT | {"fx": 525.0, "fy": 524.0, "ppx": 308.5, "ppy": 236.5}
GYROFLOW = {"calib_dimension": {"w": 640, "h": 480}}
GYROFLOW["fisheye_params"] = {"camera_matrix": ROWS, "distortion_coeffs": FOUR_NUMBERS}
UNBENT, ONE = replace(LENS, distortion=()), replace(LENS, distortion=(0.1,))


@pytest.mark.parametrize(
    ("text", "lens"),
    [
        ("%YAML:1.0\n" + below("Camera1.", NAMED, BENT) + SIZE + "Camera.newWidth: 600\n", LENS),
        ('Camera.type: "Rectified"\n' + below("Camera1.", NAMED) + SIZE, UNBENT),
        (
            'Camera.type: "KannalaBrandt8"\n' + below("Camera1.", NAMED, OF_FOUR)
            + below("Camera2.", "fx: 1\nfy: 1\ncx: 1\ncy: 1\nk1: 1") + SIZE,
            FISHEYE,
        ),
        (below("Camera", "model: perspective\ncols: 640\nrows: 480", NAMED, BENT)
         + below("StereoRectifier", "model: fisheye"), LENS),
        (below("Camera", "model: fisheye\ncols: 640\nrows: 480", NAMED, OF_FOUR), FISHEYE),
        (VINS + "model_type: PINHOLE\n" + below("distortion_parameters", BENT)
         + below("projection_parameters", NAMED) + "min_dist: 30\n", LENS),
        (VINS + "model_type: KANNALA_BRANDT\n" + below("projection_parameters", KANNALA), FISHEYE),
        (ROS_2 + block(ROWS) + "binning_x: 0\nroi:\n  x_offset: 0\n  width: 0\n", LENS),
        (f"{WHOLE}K: [1050, 0, 617.5, 0, 1048, 473.5, 0, 0, 1]\nbinning_x: 2\nbinning_y: 2", LENS),
        (WHOLE + "K: [525, 0, 408.5, 0, 524, 286.5, 0, 0, 1]\n"
         + below("roi", "x_offset: 100\ny_offset: 50\nheight: 480\nwidth: 640"), LENS),
        (f"cameras:\n- camera:\n{below('x', SVO)}".replace("TYPE", "radial-tangential"), LENS),
        (f"cameras:\n- camera:\n{below('x', SVO)}".replace("TYPE", "equidistant"), FISHEYE),
        (f"width: 640\nheight: 480\nK: [[525., 0, 308.5],\n  [0, 524., 236.5], [0, 0, 1]]\n"
         f"dist: [{FOUR_NUMBERS}]\n", LENS),
        (f"{VINS}camera_matrix: {{rows: 3, cols: 3, data: {np.ravel(ROWS).tolist()}}}\n"
         f"Distortion_Coefficients: {{rows: 1, data: {FOUR_NUMBERS}}}\n", LENS),
        (XML, LENS),
        (NUMBERS | WIDTH_HEIGHT | dict(k1=0.1, k2=-0.2, p1=0.01, p2=0.02), LENS),
        (GOOD | {"distortion": None, "k1": 0.1}, ONE),
        (REALSENSE | {"model": "distortion.brown_conrady", "coeffs": FOUR_NUMBERS}, LENS),
        (REALSENSE | {"model": "distortion.inverse_brown_conrady", "coeffs": [0.0] * 5}, UNBENT),
        (WIDTH_HEIGHT | {"intrinsic_matrix": np.ravel(COLUMNS).tolist()}, UNBENT),
        (WIDTH_HEIGHT | {"K": COLUMNS}, UNBENT),
        (NERF | {"camera_model": "OPENCV", "k2": -0.2, "p1": 0.01, "p2": 0.02}, LENS),
        (NERF | {"is_fisheye": True, "k2": -0.2, "k3": 0.01, "k4": 0.02}, FISHEYE),
        ({"value0": {"intrinsics": [BASALT, {}], "resolution": [[640, 480], [1, 1]]}}, FISHEYE),
        (GYROFLOW, FISHEYE),
        ("# two\n1 PINHOLE 3072 2304 9 9 9 9\n2 " + COLMAP, LENS),
    ],
)  # fmt: skip
def test_the_keys_of_other_programs_are_read_wherever_they_are(tmp_path, text, lens):
    path = tmp_path / "lens"
    path.write_text(text if isinstance(text, str) else json.dumps(text))
    assert read_calibration(path, (640, 480)) == lens


@pytest.mark.parametrize(
    ("text", "lens"),
    [
        (below("Camera.", NAMED, BENT), LENS),
        (json.dumps(NUMBERS), UNBENT),
        ("525 0 308.5\n0 524 236.5\n0 0 1\n", UNBENT),
        ("525 0 308.5 0\n0 524 236.5 0\n0 0 1 0\n0 0 0 1\n", UNBENT),
        ("525.0 524.0 308.5 236.5\n", UNBENT),
        ("P0: 525 0 308.5 0 0 524 236.5 0 0 0 1 0\nP1: 1 0 2 -9 0 1 2 0 0 0 1 0\n", UNBENT),
    ],
)
def test_a_file_without_a_size_is_of_the_pictures_with_a_warning(tmp_path, text, lens):
    path = tmp_path / "lens"
    path.write_text(text)
    with pytest.warns(UserWarning, match="lens states no image size: .* they are, 640x480"):
        assert read_calibration(path, (640, 480)) == lens
    refused(read_calibration, "lens: states no image size; add width and height", path)


def test_the_first_of_several_cameras_of_a_size_is_taken_with_a_warning(tmp_path):
    path = tmp_path / "cameras.txt"
    path.write_text(f"1 {COLMAP}\n2 {COLMAP.replace('525', '600')}\n3 PINHOLE 9 9 9 9 9 9\n")
    for size, words in (((640, 480), "the first of this size"), (None, "the first is taken")):
        with pytest.warns(UserWarning, match=f"cameras.txt has 3 cameras, of which {words}"):
            assert read_calibration(path, size) == LENS


def own(**changes):
    fields = {key: value for key, value in (GOOD | changes).items() if value is not None}
    return "own.json", json.dumps(fields)


def other(name, old, new):
    return name, OTHERS[name].replace(old, new)


@pytest.mark.parametrize(
    ("file", "words"),
    [
        (own(fx=None, cy=None), "missing fx, cy"),
        (own(model="omni"), "unknown camera model 'omni'; expected pinhole, rational, fisheye"),
        (own(model="fisheye", distortion=[0.0] * 5), "has 5 entries; expected at most k1, k2"),
        (own(fx=-525.0), "fx must be positive, not -525.0"),
        (own(fy=float("nan")), "fy must be finite, not nan"),
        (own(width=0), "width must be positive, not 0"),
        (own(width=640.5), "width must be a whole number of pixels, not 640.5"),
        (own(fx="525"), "fx must be a number, not '525'"),
        (own(height=True), "height must be a number, not True"),
        (own(distortion=0.1), "distortion must be a list"),
        (own(distortion=[0.1, "x"]), r"distortion\[1\] must be a number, not 'x'"),
        (own(sigma=[1.0, 1.0, 1.0, 1.0]), "an object with fx, fy, cx, cy"),
        (own(sigma=SIGMAS | {"fx": -1.0}), "sigma of fx must not be negative, not -1.0"),
        (own(sigma=SIGMAS | {"fx": "1"}), "sigma of fx must be a number, not '1'"),
        (("own.json", "{"), "not a JSON file"),
        (("own.json", "[1]"), "expected a JSON object, not a list"),
        (("own.json", None), "cannot read"),
        (other("camchain.yaml", "pinhole", "omni"), "unknown lens, omni radtan; exp"),
        (other("ros.yaml", "0.02, 0]", "0.02, 0, 0, 0, 0, 0.3]"), "of 9 numbers; expected plumb"),
        (other("ros.yaml", "image_width: 640\n", ""), "states no image size; add width"),
        (other("cameras.txt", "OPENCV", "FOV"), "unknown camera model FOV of 10"),
        (
            ("k.json", json.dumps(GOOD | {"distortion": [], "lens_distortion": [0.1]})),
            "its lens_distortion is not read; name it distortion",
        ),
        (
            ("k.json", json.dumps(WIDTH_HEIGHT | {"K": [[525.0, 3.0, 308.5], *ROWS[1:]]})),
            r"its matrix \[\[525.0, 3.0, 308.5\], .* is not \[fx 0 cx; 0 fy cy; 0 0 1\]",
        ),
        (own(fx=0.82, fy=1.1), "fx is 0.82; focal lengths and centre are in pixels"),
        (
            ("vins.yaml", "model_type: MEI\nmirror_parameters:\n  xi: 1.9\n"),
            "unknown lens, MEI; expe",
        ),
        (
            ("svo.yaml", SVO.replace("TYPE", "fisheye").replace("0.1, -0.2, 0.01, 0.02", "0.93")),
            "unknown lens, fisheye of 1 numbers; expected",
        ),
        (
            (
                "rs.json",
                json.dumps(REALSENSE | {"model": "inverse_brown_conrady", "coeffs": [0.1]}),
            ),
            "unknown lens, inverse_brown_conrady of 1 numbers",
        ),
        (
            ("agisoft.xml", "<c><width>640</width><f>525</f><cx>-11</cx><k1>0.1</k1></c>"),
            "no camera matrix of finite .*, and no fx, fy, cx, cy; its keys are width, f, cx, k1",
        ),
        (("broken.yaml", "width: [1, 2\nK: 3\n"), "broken.yaml: not a YAML file"),
        (("broken.xml", "<c><width>640</c>"), "mismatched tag"),
        (("ost.txt", "# oST\n[image]\nwidth\n640\n"), "no camera matrix of finite numbers"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_what_is_no_calibration_is_refused_naming_file_and_field(file, words, tmp_path):
    path, text = tmp_path / file[0], file[1]
    if text is not None:
        path.write_text(text)
    assert str(path) in refused(read_calibration, words, path)
