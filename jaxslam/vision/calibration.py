"""A camera's calibration: pinhole with OpenCV's distortion, and the JSON file that holds it."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxslam.files import write_atomically

MODEL = "pinhole"
_KEYS = ("width", "height", "fx", "fy", "cx", "cy")


@dataclass(frozen=True)
class Calibration:
    """Pinhole intrinsics and OpenCV's distortion, for one image size.

    `width`, `height`, `fx`, `fy`, `cx`, `cy` are in pixels, the centre of the first pixel is
    (0, 0); `distortion` holds OpenCV's k1, k2, p1, p2, k3 (no unit), a shorter one is padded
    with zeros. Raises `ValueError` for numbers that cannot be a camera's.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for key in _KEYS:
            _require_number(key, getattr(self, key))
        for key in ("width", "height"):
            value = getattr(self, key)
            if value != int(value):
                raise ValueError(f"{key} is {value}; a whole number of pixels is accepted")
            object.__setattr__(self, key, int(value))
        for key in ("fx", "fy", "cx", "cy"):
            object.__setattr__(self, key, float(getattr(self, key)))
        for key in ("width", "height", "fx", "fy"):
            if getattr(self, key) <= 0:
                raise ValueError(f"{key} is {getattr(self, key)}; a positive number is accepted")
        object.__setattr__(self, "distortion", _padded(self.distortion))

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """The pinhole matrix K in pixels: pixel (u, v, 1) ~ K (x, y, z)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


def read_calibration(path: str | Path) -> Calibration:
    """The calibration in a JSON file with model, width, height, fx, fy, cx, cy and distortion.

    Further keys are ignored. Raises `ValueError`, naming the file, where it is missing, is not
    JSON, or does not hold a pinhole camera.
    """
    path = Path(path)
    try:
        fields = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path}: cannot read the calibration ({error.strerror})") from None
    except ValueError as error:  # bad JSON and bad UTF-8 alike
        raise ValueError(f"{path}: not a JSON file ({error})") from None
    try:
        return _from_fields(fields)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def write_calibration(path: str | Path, calibration: Calibration) -> None:
    """Write the JSON file that `read_calibration` reads, whole or not at all."""
    text = json.dumps({"model": MODEL, **asdict(calibration)}, indent=1) + "\n"
    with write_atomically(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _from_fields(fields: Any) -> Calibration:
    if not isinstance(fields, dict):
        raise ValueError(f"holds a {type(fields).__name__}; a JSON object is accepted")
    model = fields.get("model", MODEL)
    if model != MODEL:
        raise ValueError(f"camera model {model!r} is unknown; {MODEL!r} is accepted")
    missing = [key for key in _KEYS if key not in fields]
    if missing:
        raise ValueError(f"{', '.join(missing)} missing; {', '.join(_KEYS)} are needed")
    distortion = fields.get("distortion", [])
    if not isinstance(distortion, list):
        raise ValueError("distortion is not a list; OpenCV's k1, k2, p1, p2, k3 are accepted")
    return Calibration(**{key: fields[key] for key in _KEYS}, distortion=tuple(distortion))


def _require_number(name: str, value: object) -> None:
    # bool is an int to Python, but `true` in the file is a mistake.
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise ValueError(f"{name} is {value!r}; a number is accepted")
    if not math.isfinite(value):
        raise ValueError(f"{name} is {value}; a finite number is accepted")


def _padded(distortion: Sequence[float]) -> tuple[float, ...]:
    if len(distortion) > 5:
        raise ValueError(
            f"distortion has {len(distortion)} entries; k1, k2, p1, p2, k3 at most are accepted"
        )
    for index, value in enumerate(distortion):
        _require_number(f"distortion[{index}]", value)
    return tuple(float(value) for value in distortion) + (0.0,) * (5 - len(distortion))
