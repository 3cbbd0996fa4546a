"""A camera's calibration in the files of other programs: YAML of OpenCV, ROS, Kalibr, EuRoC and
ORB-SLAM, JSON of any of their keys, and COLMAP's `cameras.txt`."""

import json
import re
from collections.abc import Sequence
from pathlib import Path

from jaxslam.io.calibration import INTRINSICS, Calibration, from_fields
from jaxslam.io.text import numbers, numbers_of, text_lines

_MODELS = {
    **dict.fromkeys(("pinhole", "plumb_bob", "radtan", "radial-tangential", "opencv", "none"), ""),
    **dict.fromkeys(("rational_polynomial", "rational"), "rational"),
    **dict.fromkeys(
        ("equidistant", "equi", "fisheye", "kannala_brandt", "kannalabrandt8"), "fisheye"
    ),
}
"""Our models by what programs call cameras and their distortion; "" of OpenCV's numbers, which are
rational where they are more than five."""
_NAMES = ("camera_model", "Camera.type", "distortion_model")
_SIZE = (("width", "image_width", "Camera.width"), ("height", "image_height", "Camera.height"))
_MATRIX = ("camera_matrix.data", "camera_matrix", "K.data", "K", "intrinsics", "Camera")
_DISTORTION = (
    "distortion_coefficients.data", "distortion_coefficients", "distortion_coeffs",
    "dist_coeff.data", "dist_coeff", "dist_coeffs", "D.data", "D", "distortion",
)  # fmt: skip
_COLMAP = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8,
    "FULL_OPENCV": 12, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "OPENCV_FISHEYE": 8,
}  # fmt: skip
"""How many parameters COLMAP's models have: focal lengths, one of simple and radial ones, centre
and distortion."""
ACCEPTED = (
    "JSON with model, width, height, fx, fy, cx, cy, distortion; YAML of OpenCV, ROS, Kalibr, "
    "EuRoC or ORB-SLAM; or COLMAP's cameras.txt"
)


def read_calibration(path: str | Path) -> Calibration:
    """The calibration in a JSON file as `write_calibration` writes it, or of another program.

    Raises `ValueError`, naming the file, where it is missing, or holds no lens of
    `jaxslam.models.lens`.
    """
    lines = list(text_lines(path, "calibration").values())
    try:
        if lines and lines[0].lstrip().startswith(("{", "[")):
            fields = json.loads("\n".join(lines))
            plain = not isinstance(fields, dict) or "fx" in fields or "model" in fields
            return from_fields(fields) if plain else of_keys(_flat(fields))
        if any(re.fullmatch(r"\d+ [A-Z_]+( [-+.\deE]+)+", line) for line in lines):
            return _of_colmap(lines)
        return of_keys(yaml_keys(Path(path).read_text(encoding="utf-8-sig")))
    except ValueError as error:
        told = f"not a JSON file ({error})" if isinstance(error, json.JSONDecodeError) else error
        raise ValueError(f"{path}: {told}; expected {ACCEPTED}") from None


def of_keys(fields: dict[str, object]) -> Calibration:
    """The calibration of the keys that programs use. Raises ValueError for what is none."""
    size = numbers_of(fields.get("resolution"))
    if len(size) != 2:
        size = [x for names in _SIZE for x in _first(fields, names)]
    matrix = _first(fields, _MATRIX) or numbers_of([fields.get(f"Camera.{x}") for x in INTRINSICS])
    matrix = [matrix[i] for i in (0, 4, 2, 5)] if len(matrix) == 9 else matrix
    names = [str(fields[key]) for key in _NAMES if fields.get(key)]
    names += (
        ["fisheye"] if numbers_of(fields.get("fisheye_model")) == [1.0] else []
    )  # OpenCV's flag
    distortion = _first(fields, _DISTORTION)
    if not distortion and "Camera.k1" in fields:
        order = "k1 k2 k3 k4" if "Camera.k4" in fields else "k1 k2 p1 p2 k3"
        distortion = numbers_of([fields.get(f"Camera.{x}", 0) for x in order.split()])
    model, distortion = lens(names, distortion)
    if len(size) != 2 or len(matrix) != 4:
        told = ", ".join(list(fields)[:12]) or "none"
        raise ValueError(f"has no image size or no camera matrix; its keys are {told}")
    return Calibration(int(size[0]), int(size[1]), *matrix, distortion=distortion, model=model)


def lens(names: Sequence[str], distortion: Sequence[float]) -> tuple[str, tuple[float, ...]]:
    """Our model and its numbers of a distortion, by all `names` that a program gives it (Kalibr's
    `pinhole-equi` is two). Raises ValueError for one that is none of ours."""
    words = [
        word for name in map(str.lower, names)
        for word in ([name] if name in _MODELS else name.split("-"))
    ]  # fmt: skip
    model = next(filter(None, map(_MODELS.get, words)), "")
    told = [float(x) for x in distortion]
    most = 4 if model == "fisheye" else 8
    if not set(words) <= _MODELS.keys() or any(told[most:]):
        which = " ".join(names) or "no name"
        raise ValueError(
            f"unknown lens, {which} of {len(told)} numbers; expected plumb_bob (radtan), "
            "rational_polynomial or equidistant (fisheye); undistort the pictures, or calibrate "
            "anew (jaxslam calibrate)"
        )
    if model != "fisheye":  # a rational polynomial of zeros is a pinhole's
        model = "rational" if any(told[5:]) else "pinhole"
    return model, tuple(told[: 5 if model == "pinhole" else most])


def _of_colmap(lines: Sequence[str]) -> Calibration:
    """The first camera; its pixels begin at the corner of the first one, ours in its middle."""
    name, *told = next(line.split()[1:] for line in lines if line[0].isdigit())
    values = numbers(told, len(told)) or []
    if len(values) != 2 + _COLMAP.get(name, -2):
        known = ", ".join(_COLMAP)
        raise ValueError(f"unknown camera model {name} of {len(told)} numbers; known: {known}")
    width, height, focal, *rest = values
    square = [focal] if name.startswith(("SIMPLE", "RADIAL")) else []
    fx, fy, cx, cy, *distortion = [*square, focal, *rest]
    model, distortion = lens(["fisheye"] if name.endswith("FISHEYE") else [], distortion)
    size = int(width), int(height)
    return Calibration(*size, fx, fy, cx - 0.5, cy - 0.5, distortion=distortion, model=model)


def yaml_keys(text: str) -> dict[str, object]:
    """The keys, of nested ones joined by dots, and their numbers, lists or words; what such files
    have of YAML, and the first of several cameras or IMUs."""
    text = re.sub(r"\[([^\]]*)\]", lambda x: "[" + " ".join(x[1].split()) + "]", text)
    whole: dict[str, str] = {}
    above: list[tuple[int, str]] = []
    for line in text.splitlines():
        name = ".".join(x for _, x in above)
        if (row := re.match(r"\s*-\s*\[(.*)\]", line)) and name:  # of a matrix
            whole[name] = f"{whole.get(name, '')} {row[1]}"
        found = re.fullmatch(r"(\s*)([\w./-]+)\s*:(?:\s+(.*?))?\s*(?:#.*)?", line)
        if found is None:
            continue
        indent, key, value = len(found[1]), found[2], re.sub(r"^!!\S+", "", found[3] or "").strip()
        above = [x for x in above if x[0] < indent]
        if value:
            whole.setdefault(".".join([*(x for _, x in above), key]), value.strip("\"'"))
        else:
            above.append((indent, key))
    fields: dict[str, object] = {}
    for name, value in whole.items():
        fields.setdefault(re.sub(r"(^|\.)(cam|imu)\d+\.", r"\1", name), value)
    return fields


def _flat(fields: dict[str, object], before: str = "") -> dict[str, object]:
    result: dict[str, object] = {}
    for key, value in fields.items():
        if isinstance(value, dict):
            result |= _flat(value, f"{before}{key}.")
        else:
            result[f"{before}{key}"] = value
    return result


def _first(fields: dict[str, object], names: Sequence[str]) -> list[float]:
    return next((found for name in names if (found := numbers_of(fields.get(name)))), [])
