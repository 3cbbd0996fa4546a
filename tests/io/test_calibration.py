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
        (other("camchain.yaml", "pinhole", "omni"), "unknown lens, omni radtan of 4 numbers; exp"),
        (other("ros.yaml", "0.02, 0]", "0.02, 0, 0, 0, 0, 0.3]"), "of 9 numbers; expected plumb"),
        (other("ros.yaml", "image_width: 640\n", ""), "has no image size or no camera matrix; i"),
        (other("cameras.txt", "OPENCV", "FOV"), "unknown camera model FOV of 10"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_what_is_no_calibration_is_refused_naming_file_and_field(file, words, tmp_path):
    path, text = tmp_path / file[0], file[1]
    if text is not None:
        path.write_text(text)
    assert str(path) in refused(read_calibration, words, path)
