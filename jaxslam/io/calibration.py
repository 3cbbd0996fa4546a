"""A camera's calibration: intrinsics and lens, and the JSON file that holds it."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxslam._runtime.files import Json, write_json

INTRINSICS = ("fx", "fy", "cx", "cy")
_KEYS = ("width", "height", *INTRINSICS)
MODELS = {
    "pinhole": "k1 k2 p1 p2 k3",
    "rational": "k1 k2 p1 p2 k3 k4 k5 k6",
    "fisheye": "k1 k2 k3 k4",
}
"""The numbers of every model's lens, in order (`jaxslam.models.lens`)."""
GUESSED_FIELD_OF_VIEW = 65.0
"""Degrees along the longer side: between a phone that films and a webcam."""
LENS_SIGMA = (0.15, 0.05)
"""σ of k1 and k2, as phones differ, of a lens of which at most the field of view is given."""
_GUESSED_SHARE, _TOLD_SHARE, _CENTRE_SHARE = 0.15, 0.05, 0.02
"""σ of a focal length that is guessed, and of one that a field of view tells (cropped by who knows
what), as shares of it; σ of the principal point as a share of the longer side."""


@dataclass(frozen=True)
class Calibration:
    """Intrinsics and lens of a camera, for one image size.

    `width`, `height`, `fx`, `fy`, `cx`, `cy` are in pixels, the centre of the first pixel is
    (0, 0); `distortion` holds the numbers (no unit) of the lens, which `MODELS` names by its
    `model`: of a pinhole OpenCV's k1, k2, p1, p2, k3. A shorter one is padded with zeros. `sigma`
    are standard deviations of fx, fy, cx, cy, pixels; none where they are unknown. A `guessed` one
    has square pixels, so that fx and fy are off by one number.
    Raises `ValueError` for numbers that cannot be a camera's.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    sigma: tuple[float, ...] = ()
    guessed: bool = False
    model: str = "pinhole"

    def __post_init__(self) -> None:
        for key in _KEYS:
            value, kind = getattr(self, key), float if key in INTRINSICS else int
            _require_number(key, value)
            if value != kind(value):
                raise ValueError(f"{key} must be a whole number of pixels, not {value}")
            if value <= 0 and key not in ("cx", "cy"):
                raise ValueError(f"{key} must be positive, not {value}")
            object.__setattr__(self, key, kind(value))
        object.__setattr__(self, "distortion", _padded(self.model, self.distortion))
        object.__setattr__(self, "sigma", _checked_sigma(self.sigma))

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """The pinhole matrix K in pixels: pixel (u, v, 1) ~ K (x, y, z)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def resized(self, width: int, height: int) -> "Calibration":
        """The calibration of the same pictures at another size: u' + 1/2 = s (u + 1/2).

        Raises ValueError for a size that no picture has.
        """
        for name, pixels in (("width", width), ("height", height)):
            if pixels < 1:
                raise ValueError(f"{name} would be {pixels}; it must be at least one pixel")
        x, y = width / self.width, height / self.height
        fx, fy = x * self.fx, y * self.fy
        cx, cy = x * (self.cx + 0.5) - 0.5, y * (self.cy + 0.5) - 0.5
        sigma = tuple(s * sigma for s, sigma in zip((x, y, x, y), self.sigma, strict=False))
        return replace(self, width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, sigma=sigma)


def from_field_of_view(width: int, height: int, degrees: float | None = None) -> Calibration:
    """An ideal lens with a horizontal field of view, or with a usual one, its focal length unsure.

    `f = (w/2) / tan(fov/2)`; the pixels are square, the axis goes through the middle.
    """
    if degrees is not None and not 0 < degrees < 180:
        raise ValueError(f"fov must be between 0° and 180°, not {degrees}°")
    side, fov = (max(width, height), GUESSED_FIELD_OF_VIEW) if degrees is None else (width, degrees)
    focal = side / 2 / math.tan(math.radians(fov) / 2)
    of_focal = focal * (_GUESSED_SHARE if degrees is None else _TOLD_SHARE)
    of_centre = _CENTRE_SHARE * max(width, height)
    return Calibration(
        width, height, focal, focal, (width - 1) / 2, (height - 1) / 2,
        sigma=(of_focal, of_focal, of_centre, of_centre), guessed=True,
    )  # fmt: skip


def write_calibration(path: str | Path, calibration: Calibration, **further: Json) -> None:
    """Write the JSON file that `read_calibration` reads, whole or not at all.

    `further` keys are for people; one that is there already is merged into it.
    """
    fields = as_fields(calibration)
    for key, value in further.items():
        fields[key] = {**fields[key], **value} if key in fields else value
    write_json(path, fields, allow_nan=False)


def as_fields(calibration: Calibration) -> dict[str, Json]:
    """The fields of the file; those not stated are left out."""
    fields = {"model": calibration.model, **asdict(calibration)}
    fields["sigma"] = dict(zip(INTRINSICS, calibration.sigma, strict=False))
    return {key: value for key, value in fields.items() if value or key not in ("sigma", "guessed")}


def from_fields(fields: object) -> Calibration:
    """The calibration of these fields, the inverse of `as_fields`.

    Raises ValueError for what is no camera's.
    """
    if not isinstance(fields, dict):
        raise ValueError(f"expected a JSON object, not a {type(fields).__name__}")
    if missing := [key for key in _KEYS if key not in fields]:
        raise ValueError(f"missing {', '.join(missing)}; {', '.join(_KEYS)} are needed")
    distortion = fields.get("distortion", [])
    if not isinstance(distortion, list):
        raise ValueError("distortion must be a list of the lens's numbers, k1 first")
    numbers, sigma = {key: fields[key] for key in _KEYS}, _sigma_from(fields.get("sigma", {}))
    return Calibration(
        **numbers, distortion=tuple(distortion), sigma=sigma,
        guessed=fields.get("guessed") is True, model=str(fields.get("model", "pinhole")),
    )  # fmt: skip


def _sigma_from(sigma: object) -> tuple[float, ...]:
    if not isinstance(sigma, dict) or (sigma and not sigma.keys() >= set(INTRINSICS)):
        raise ValueError(f"sigma must be an object with {', '.join(INTRINSICS)}, not {sigma!r}")
    return tuple(sigma[key] for key in INTRINSICS) if sigma else ()


def _require_number(name: str, value: object) -> None:
    # bool is an int to Python, but `true` in the file is a mistake.
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise ValueError(f"{name} must be a number, not {value!r}")
    if not abs(value) < math.inf or (isinstance(value, int) and abs(value) > 2**63):
        raise ValueError(f"{name} must be finite, not {value}")


def _checked_sigma(sigma: Sequence[float]) -> tuple[float, ...]:
    if len(sigma) not in (0, 4):
        raise ValueError(f"sigma has {len(sigma)} entries; expected those of fx, fy, cx, cy")
    for key, value in zip(INTRINSICS, sigma, strict=False):
        _require_number(f"sigma of {key}", value)
        if value < 0:
            raise ValueError(f"sigma of {key} must not be negative, not {value}")
    return tuple(float(value) for value in sigma)


def _padded(model: str, distortion: Sequence[float]) -> tuple[float, ...]:
    if model not in MODELS:
        raise ValueError(f"unknown camera model {model!r}; expected {', '.join(MODELS)}")
    names = MODELS[model].split()
    if len(distortion) > len(names):
        raise ValueError(
            f"distortion has {len(distortion)} entries; expected at most {', '.join(names)}"
        )
    for index, value in enumerate(distortion):
        _require_number(f"distortion[{index}]", value)
    return tuple(map(float, distortion)) + (0.0,) * (len(names) - len(distortion))
