"""The calibration file: what is read back, and what is refused with which words."""

import json

import numpy as np
import pytest

from jaxslam.vision.calibration import Calibration, read_calibration, write_calibration

GOOD = {
    "model": "pinhole",
    "width": 640,
    "height": 480,
    "fx": 525.0,
    "fy": 524.0,
    "cx": 308.5,
    "cy": 236.5,
    "distortion": [0.1, -0.2],
}


def write(path, **changes):
    fields = {**GOOD, **changes}
    path.write_text(json.dumps({key: value for key, value in fields.items() if value is not None}))
    return path


def test_written_calibration_is_read_back(tmp_path):
    calibration = Calibration(640, 480, 525.06, 524.2, 308.6, 236.5, (0.1, -0.2, 1e-4, 2e-4, 0.3))
    write_calibration(tmp_path / "calibration.json", calibration)
    assert read_calibration(tmp_path / "calibration.json") == calibration
    assert [file.name for file in tmp_path.iterdir()] == ["calibration.json"]


def test_matrix_projects_as_a_pinhole(tmp_path):
    calibration = read_calibration(write(tmp_path / "c.json"))
    u, v, w = calibration.matrix @ np.array([0.4, -0.2, 2.0])
    assert (u / w, v / w) == pytest.approx((525.0 * 0.2 + 308.5, 524.0 * -0.1 + 236.5))


@pytest.mark.parametrize("given", [[], [0.1], [0.1, -0.2, 0.01, 0.02]])
def test_short_distortion_is_padded(tmp_path, given):
    calibration = read_calibration(write(tmp_path / "c.json", distortion=given))
    assert calibration.distortion == tuple(given) + (0.0,) * (5 - len(given))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fx": None, "cy": None}, "fx, cy missing"),
        ({"model": "fisheye"}, "'fisheye' is unknown"),
        ({"fx": -525.0}, "fx is -525.0; a positive"),
        ({"fy": float("nan")}, "fy is nan; a finite"),
        ({"cx": float("inf")}, "cx is inf; a finite"),
        ({"width": 0}, "width is 0; a positive"),
        ({"width": 640.5}, "width is 640.5; a whole"),
        ({"fx": "525"}, "fx is '525'; a number"),
        ({"height": True}, "height is True; a number"),
        ({"distortion": [0.0] * 6}, "has 6 entries"),
        ({"distortion": 0.1}, "distortion is not a list"),
        ({"distortion": [0.1, "x"]}, r"distortion\[1\] is 'x'"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_bad_fields_are_refused_naming_file_and_field(tmp_path, changes, words):
    path = write(tmp_path / "bad.json", **changes)
    with pytest.raises(ValueError, match=words) as caught:
        read_calibration(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"), [("{", "not a JSON file"), ("[1]", "holds a list"), (None, "cannot read")]
)
def test_other_files_are_refused(tmp_path, text, words):
    path = tmp_path / "c.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ValueError, match=words):
        read_calibration(path)
