"""A camera's calibration in the files of other programs: YAML, JSON and XML of the keys that they
use, COLMAP's `cameras.txt`, and a matrix alone."""

import json
import re
import tomllib
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from jaxslam._runtime.extras import missing
from jaxslam._runtime.files import one_line
from jaxslam.io.calibration import INTRINSICS, MODELS, Calibration, from_fields
from jaxslam.io.text import numbers_of, text_lines

Size = tuple[int, int] | None
"""Width and height of the pictures, where they are known."""
_WORDS = tomllib.loads(Path(__file__).with_suffix(".toml").read_text())
_KEYS, _COLMAP = _WORDS["keys"], _WORDS["colmap"]
_MODELS = {name: model for model, names in _WORDS["models"].items() for name in names}
"""Our models by what programs call cameras and their distortion; `pinhole` of OpenCV's numbers,
which are rational where they are more than five."""
_BENDS = re.compile(r"d|dist|.*distortion.*|.*coeff.*|[kp]\d|xi")
"""The last part of a key of what bends pictures: one that is not read is not passed over."""
_PART = ("x_offset", "y_offset", "roi.width", "roi.height", "binning_x", "binning_y")
ACCEPTED = (
    "JSON with model, width, height, fx, fy, cx, cy, distortion; YAML, JSON or XML of OpenCV, ROS, "
    "Kalibr, EuRoC, ORB-SLAM, VINS, Basalt, RealSense or nerfstudio; COLMAP's cameras.txt (of "
    "cameras.bin: colmap model_converter); or a matrix of 3x3"
)


def read_calibration(path: str | Path, size: Size = None) -> Calibration:
    """The calibration in a JSON file as `write_calibration` writes it, or of another program.

    A file that states no size is taken to be of pictures of this `size`, with a warning. Raises
    `ValueError`, naming the file, where it is missing, or holds no lens of `jaxslam.models.lens`.
    """
    try:
        lines = list(text_lines(path, "calibration").values())
        calibration = _of_text(Path(path), lines, size)
        if calibration.fx < 0.02 * calibration.width:
            raise ValueError(f"fx is {calibration.fx:g}; focal lengths and centre are in pixels")
    except (ValueError, ElementTree.ParseError) as error:
        told = f"not a JSON file ({error})" if isinstance(error, json.JSONDecodeError) else error
        told = str(told).removeprefix(f"{path}: ")
        accepted = "" if "expected" in told else f"; expected {ACCEPTED}"
        raise ValueError(f"{path}: {told}{accepted}") from None
    return calibration


def _of_text(path: Path, lines: list[str], size: Size) -> Calibration:
    text = "\n".join(lines)
    if any(re.fullmatch(r"\d+ [A-Z_]+( [-+.\deE]+)+", line) for line in lines):
        return _of_colmap(path, lines, size)
    if text.startswith("{") or (text.startswith("[") and text.endswith("]")):
        fields = json.loads(text)
        foreign = {x for x in fields if _BENDS.fullmatch(str(x).lower())} - {"distortion"}
        own = "model" in fields or {"fx", "distortion"} <= {*fields}
        if not isinstance(fields, dict) or (own and not foreign):
            return from_fields(fields)
        fields = _flat(fields)
    elif text.startswith("<"):
        fields = _flat(_tree(ElementTree.fromstring(text)))
    else:
        matrix = numbers_of(text)
        fields = {"K": matrix} if matrix else yaml_keys(path)
    return of_keys(fields, size, path)


def of_keys(fields: dict[str, object], size: Size = None, what: object = "") -> Calibration:
    """The calibration of the keys that programs use, in whatever letters and below whatever others.

    Raises ValueError for what is none, and for a distortion by a key that is not known.
    """
    told = {re.sub(r"\.data$", "", key.lower()): value for key, value in fields.items()}
    keys, read = sorted(told, key=lambda key: key.count(".")), list[str]()

    def first(names: Sequence[str]) -> list[float]:
        for key in (x for name in names for x in keys if f".{x}".endswith(f".{name}")):
            if found := numbers_of(told[key]):
                read.append(key)
                return found
        return []

    matrix = _pinhole(first(_KEYS["matrix"]))
    matrix = matrix or [x for name in INTRINSICS for x in first(_KEYS[name])[:1]]
    place = read[0] if read else ""
    named = ((key, x) for key in keys for x in _KEYS["name"] if f".{key}".endswith(f".{x}"))
    names = [str(told[key]) for key in {k: 0 for k, x in named if place.startswith(k[: -len(x)])}]
    lens(names, ())  # of which no camera matrix need be known
    if len(matrix) != 4:
        known = ", ".join(list(fields)[:12]) or "none"
        raise ValueError(
            f"has no camera matrix of finite numbers, and no fx, fy, cx, cy; its keys are {known}"
        )
    corner = 0.5 * any(x.endswith("fl_x") for x in read)  # COLMAP's pixels begin there
    matrix = [*matrix[:2], *(x - corner for x in matrix[2:])]
    flags = first(_KEYS["fisheye"]) == [1.0]
    names += ["fisheye"] * (flags or any("fisheye" in x.rpartition(".")[0] for x in read))
    order = MODELS["fisheye" if lens(names, ())[0] == "fisheye" else "rational"].split()
    order = ["k2", "k3", "k4", "k5"] if any(x.endswith("mu") for x in read) else order
    single = [first([x]) for x in order]
    distortion = first(_KEYS["distortion"]) or [x[0] if len(x) == 1 else 0.0 for x in single]
    last = {x.rpartition(".")[2] for x in read}
    for key, value in told.items():
        name, found = key.rpartition(".")[2], numbers_of(value)
        if any(found) and name not in last and _BENDS.fullmatch(name):
            raise ValueError(f"its {key} is not read; name it distortion, in OpenCV's order")
    model, distortion = lens(names, distortion)
    whole = first(_KEYS["size"])[:2]
    whole = whole or [*first(_KEYS["width"])[:1], *first(_KEYS["height"])[:1]]
    if len(whole) != 2 and size is not None:
        as_they_are = f"it is taken to be of the pictures as they are, {size[0]}x{size[1]}"
        warnings.warn(f"{what} states no image size: {as_they_are}", stacklevel=4)
        whole = [*map(float, size)]
    if len(whole) != 2 or any(x % 1 for x in whole):
        raise ValueError("states no image size; add width and height, whole numbers of pixels")
    part, (width, height) = [int((first([x]) or [0])[0]) for x in _PART], map(int, whole)
    return as_sent(Calibration(width, height, *matrix, distortion=distortion, model=model), part)


def as_sent(whole: Calibration, part: Sequence[int]) -> Calibration:
    """The calibration of the pictures that a ROS driver sends of a whole sensor: a region of
    interest (x, y, width, height; all of it where zero) with pixels binned (across, down)."""
    x, y, width, height, *binned = part
    if width and height:
        whole = replace(whole, width=width, height=height, cx=whole.cx - x, cy=whole.cy - y)
    across, down = (max(n, 1) for n in binned)
    return whole.resized(whole.width // across, whole.height // down)


def _pinhole(matrix: Sequence[float]) -> list[float]:
    """fx, fy, cx, cy of these four, or of a matrix of 3x3 to 4x4, by its rows or its columns.

    Raises ValueError for a matrix that is no camera's.
    """
    if len(matrix) not in (9, 12, 16):
        return list(matrix)
    K = np.reshape(matrix, (-1, 3 if len(matrix) == 9 else 4))[:3, :3]
    K = K if K[:2, 2].any() else K.T  # by columns, as Open3D and MATLAB write it
    expected = np.array([[K[0, 0], 0, K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]])
    if not (np.abs(K - expected) <= 1e-3 * abs(K[0, 0])).all():
        raise ValueError(f"its matrix {K.tolist()} is not [fx 0 cx; 0 fy cy; 0 0 1]")
    return [float(x) for x in (K[0, 0], K[1, 1], K[0, 2], K[1, 2])]


def lens(names: Sequence[str], distortion: Sequence[float]) -> tuple[str, tuple[float, ...]]:
    """Our model and its numbers of a distortion, by all `names` that a program gives it (Kalibr's
    `pinhole-equi` is two). Raises ValueError for one that is none of ours."""
    told, words = [float(x) for x in distortion], []
    for name in (name.lower().removeprefix("distortion.").replace(" ", "_") for name in names):
        words += [name] if name in _MODELS else name.split("-")
    words = [x for x in words if x != "inverse_brown_conrady" or any(told)]  # RealSense's zeros
    model = next((x for x in map(_MODELS.get, words) if x != "pinhole"), "pinhole")
    most = 4 if model == "fisheye" else 8
    atan = model == "fisheye" and 0 < len(told) < 4  # SVO's, of one number
    if not set(words) <= _MODELS.keys() or any(told[most:]) or atan:
        which = (" ".join(names) or "no name") + f" of {len(told)} numbers" * bool(told)
        raise ValueError(
            f"unknown lens, {which}; expected plumb_bob (radtan), "
            "rational_polynomial (8 numbers) or equidistant (fisheye); undistort the pictures, or "
            "calibrate anew (jaxslam calibrate)"
        )
    if model != "fisheye":  # a rational polynomial of zeros is a pinhole's
        model = "rational" if any(told[5:]) else "pinhole"
    return model, tuple(told[: 5 if model == "pinhole" else most])


def _of_colmap(path: Path, lines: Sequence[str], size: Size) -> Calibration:
    """The only camera, or that of pictures of this size."""
    cameras = [line.split()[1:] for line in lines if line[0].isdigit()]
    fit = [x for x in cameras if size is not None and x[1:3] == [str(n) for n in size]] or cameras
    if len(fit) > 1:
        told = f"{path} has {len(cameras)} cameras, of which the first"
        warnings.warn(f"{told} {'of this size ' * (fit != cameras)}is taken", stacklevel=4)
    name, *told = fit[0]
    keys = ["width", "height", *_COLMAP.get(name, ())]
    if len(told) != len(keys) or name not in _COLMAP:
        known = ", ".join(_COLMAP)
        raise ValueError(f"unknown camera model {name} of {len(told)} numbers; known: {known}")
    return of_keys({"model": name, **dict(zip(keys, told, strict=True))})


def yaml_keys(path: Path) -> dict[str, object]:
    """The keys of a YAML file, of nested ones joined by dots, and their numbers, lists or words; of
    the first of several cameras or IMUs. Raises ValueError, naming a file that is none."""
    try:
        import yaml
    except ImportError as error:
        raise missing(f"{path}: YAML needs", "vision", error) from None
    # OpenCV's directive and types are its own.
    text = path.read_text(encoding="utf-8-sig", errors="replace").expandtabs()
    told = re.sub(r"^%.*|!!\S+", "", text, flags=re.MULTILINE)
    try:
        fields = next(iter(yaml.safe_load_all(told)), None)
    except yaml.YAMLError as error:
        raise ValueError(f"{path}: not a YAML file ({one_line(error)})") from None
    result: dict[str, object] = {}
    for name, value in _flat(fields if isinstance(fields, dict) else {}).items():
        result.setdefault(re.sub(r"(^|\.)([Cc]am(?:era)?|imu)\d+\.", r"\1", name), value)
    return result


def _tree(element: ElementTree.Element) -> dict[str, object]:
    return {x.tag: _tree(x) if len(x) else x.text for x in element}


def _flat(value: object, name: str = "") -> dict[str, object]:
    """Nested keys joined by dots; of a list of objects the first one's."""
    own = value[0] if isinstance(value, list) and value else value
    if not isinstance(own, dict):
        return {name: value}
    parts = (_flat(x, f"{name}.{key}" if name else str(key)) for key, x in own.items())
    return {key: x for part in parts for key, x in part.items()}
