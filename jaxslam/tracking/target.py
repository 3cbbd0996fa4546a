"""Known points that the first picture sees, which give the map its metre.

MonoSLAM's start (Davison, Reid, Molton, Stasse, PAMI 2007): a picture of known size on the wall.
"""

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from jaxslam._runtime.files import Json, read_json
from jaxslam.io.calibration import Calibration
from jaxslam.io.recording import read_image
from jaxslam.io.text import vector_of
from jaxslam.io.tum import transforms
from jaxslam.tracking.optics import on_pinhole, rays
from jaxslam.tracking.patches import Picture
from jaxslam.tracking.pose_with_covariance import Places, Positions, Transform

LEAST_POINTS = 4
_IDEAL = np.zeros(0)
"""No distortion."""
_CORNER_REACH = 3
"""Pixels to each side in which the corner that a patch shows is measured."""
_LARGEST_RMS, _LARGEST_FOUND = 2.0, 0.75
"""Pixels: what is further off is no picture of the target; of patches, which corners make exact."""


@dataclass(frozen=True)
class KnownPoint:
    """A corner whose position is known, and where it is in the first picture or how it looks."""

    name: str
    position: Float[np.ndarray, " 3"]
    """The position in the target's own frame, m."""
    pixel: Float[np.ndarray, " 2"] | None = None
    patch: Picture | None = None
    """The picture around it, about as large as it is seen; its corner is in the middle."""

    def __post_init__(self) -> None:
        if (self.pixel is None) == (self.patch is None):
            raise ValueError(
                f"point {self.name} needs either a `pixel` [u, v] or a `patch`, an image file"
            )


@dataclass(frozen=True)
class Target:
    """A target of at least four points, not on one line. Raises ValueError."""

    points: tuple[KnownPoint, ...]

    def __post_init__(self) -> None:
        if len(self.points) < LEAST_POINTS:
            raise ValueError(f"has {len(self.points)} points; at least {LEAST_POINTS} are needed")
        extent = np.linalg.svd(self.positions - self.positions.mean(axis=0), compute_uv=False)
        if extent[1] < 1e-3 * extent[0] or not extent[0]:
            raise ValueError("its points are on one line; they must span a plane")

    @property
    def positions(self) -> Positions:
        return np.array([point.position for point in self.points])


class TargetObservation(NamedTuple):
    """The place of a target in a picture, and how far away its points are."""

    pixels: Places
    T_ct: Transform
    """The target's frame in the camera, m."""
    inverse_depths: Float[np.ndarray, " n"]
    """1/z, 1/m."""
    sigma: Float[np.ndarray, " n"]
    """σ of each; taken for independent, they cover the errors that all have in common."""
    rms: float
    """The RMS reprojection error, pixels."""


def read_target(path: str | Path) -> Target:
    """The target in a JSON file: `{"points": [{"position": [x, y, z], "pixel": [u, v]}, …]}`.

    Positions are in metres, in any frame. In place of `pixel`, a place in the first picture, a
    point may have a `patch`, an image file beside the JSON's. Raises ValueError, naming file and
    point, for anything else; further keys are ignored.
    """
    folder = Path(path).parent
    return read_json(path, "target", lambda fields: _from_fields(fields, folder))


def _from_fields(fields: Json, folder: Path) -> Target:
    points = fields.get("points") if isinstance(fields, dict) else None
    if not isinstance(points, list):
        raise ValueError("has no list of points; expected an object with `points`")
    unit = fields.get("unit", "metre")
    if unit not in ("metre", "metres", "meter", "meters", "m"):
        raise ValueError(f"unit must be metre, not {unit!r}")
    return Target(tuple(_point(index, point, folder) for index, point in enumerate(points)))


def _point(index: int, fields: Json, folder: Path) -> KnownPoint:
    if not isinstance(fields, dict):
        raise ValueError(f"point {index} must be an object, not {fields!r}")
    name = str(fields.get("name", index))
    position = _numbers(f"position of point {name}", fields.get("position"), 3)
    pixel, patch = fields.get("pixel"), fields.get("patch")
    at = None if pixel is None else _numbers(f"pixel of point {name}", pixel, 2)
    image = None if patch is None else read_image(folder / str(patch))
    return KnownPoint(name, position, at, image)


def _numbers(what: str, value: Json, count: int) -> Float[np.ndarray, " n"]:
    numbers = vector_of(value, count)
    if numbers is None or not np.isfinite(numbers).all():
        raise ValueError(f"{what} must be {count} finite numbers, not {value!r}")
    return numbers


def sighted(
    target: Target, image: Picture, calibration: Calibration, pixel_sigma: float
) -> TargetObservation:
    """The target in a picture, its pixels measured with `pixel_sigma`.

    Patches are sought all over the picture; of the places where they may be, those are taken
    that the target fits best from some pose. Raises ValueError where it is not in the picture.
    """
    combined = map(np.array, itertools.product(*_places(target, image)))
    positions, K = target.positions, calibration.matrix

    def posed(pixels: Places) -> _Pose:
        return _pose(positions, on_pinhole(calibration, pixels)[0], K)

    pixels = _on_corners(target, image, min(combined, key=lambda pixels: posed(pixels).rms))
    pose = posed(pixels)
    sought = any(point.patch is not None for point in target.points)
    largest = _LARGEST_FOUND if sought else _LARGEST_RMS
    if not pose.rms <= largest:
        raise ValueError(
            f"the first picture does not show the target: its points are off by {pose.rms:.2f} px "
            f"(RMS); the limit is {largest:g} px"
        )
    return _sighting(positions, pixels, calibration, pose, pixel_sigma)


def _places(target: Target, image: np.ndarray) -> list[list[Float[np.ndarray, " 2"]]]:
    """Return where each point may be: its pixel, or where the picture is most like its patch."""
    # Of places that the patches may be at; as many are tried, at the most.
    count = max(1, int(2000 ** (1 / len(target.points))))
    return [_places_of(point, image, count) for point in target.points]


def _places_of(point: KnownPoint, image: np.ndarray, count: int) -> list[Float[np.ndarray, " 2"]]:
    name, patch = point.name, point.patch
    if patch is None:
        return [np.asarray(point.pixel)]
    if any(small > large for small, large in zip(patch.shape, image.shape, strict=True)):
        raise ValueError(f"the patch of point {name} is larger than the picture")
    alike = cv2.matchTemplate(image, patch, cv2.TM_CCOEFF_NORMED)
    highest = alike >= cv2.dilate(alike, np.ones((7, 7), np.uint8))
    # The least correlation of a patch with the picture.
    rows, columns = np.nonzero(highest & (alike > 0.8))
    if not len(rows):
        raise ValueError(f"the first picture shows nothing like the patch of point {name}")
    order = np.argsort(-alike[rows, columns])[:count]
    return list(np.stack([columns, rows], 1)[order] + (np.array(patch.shape[::-1]) - 1) / 2)


def _on_corners(target: Target, image: np.ndarray, pixels: Places) -> Places:
    """The corners beside where patches were found; pixels that were given stay."""
    found = np.array([point.patch is not None for point in target.points])
    reach = (_CORNER_REACH, _CORNER_REACH)
    end = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
    start = pixels.astype(np.float32)[:, None]
    corners = cv2.cornerSubPix(image, start.copy(), reach, (-1, -1), end)[:, 0]
    return np.where(found[:, None], corners.astype(float), pixels)


class _Pose(NamedTuple):
    """The target's frame in the camera as OpenCV has it, and the RMS in pixels that it leaves."""

    turn: np.ndarray
    shift: np.ndarray
    rms: float


def _pose(positions: Positions, pixels: Places, K: Float[np.ndarray, "3 3"]) -> _Pose:
    """Return the pose from which the points are seen there (PnP); an infinite RMS where there is
    none."""
    found, turn, shift = cv2.solvePnP(positions, pixels, K, _IDEAL, flags=cv2.SOLVEPNP_SQPNP)
    if not found:
        return _Pose(np.zeros(3), np.zeros(3), np.inf)
    seen, _ = cv2.projectPoints(positions, turn, shift, K, _IDEAL)
    depths = _in_camera(positions, turn, shift)[:, 2]
    # Ratio of the points' greatest to their least depth: seen steeper, no patch would look like it.
    if not 0 < depths.max() <= 1.5 * depths.min():
        return _Pose(turn, shift, np.inf)
    return _Pose(turn, shift, float(np.sqrt(np.mean(np.sum((seen[:, 0] - pixels) ** 2, axis=1)))))


def _in_camera(positions: Positions, turn: np.ndarray, shift: np.ndarray) -> Positions:
    return positions @ cv2.Rodrigues(turn)[0].T + shift.ravel()


def _sighting(
    positions: Positions, pixels: Places, calibration: Calibration, pose: _Pose, pixel_sigma: float
) -> TargetObservation:
    flat, K = on_pinhole(calibration, pixels)[0], calibration.matrix
    turn, shift = cv2.solvePnPRefineLM(positions, flat, K, _IDEAL, pose.turn, pose.shift)
    J = cv2.projectPoints(positions, turn, shift, K, _IDEAL)[1][:, :6]
    covariance = pixel_sigma**2 * np.linalg.pinv(J.T @ J)
    depths = _in_camera(positions, turn, shift)[:, 2]
    T_ct = transforms(cv2.Rodrigues(turn)[0], shift)
    # n diag(P) ≥ P for any covariance P of n numbers.
    sigma = np.sqrt(len(depths)) * _depth_sigma(positions, turn, covariance) / depths**2
    # One over the lens's depth, of which a fisheye's is the distance.
    share = rays(calibration, pixels)[:, 2]
    return TargetObservation(pixels, T_ct, share / depths, share * sigma, pose.rms)


def _depth_sigma(
    positions: Positions, turn: np.ndarray, covariance: Float[np.ndarray, "6 6"]
) -> Float[np.ndarray, " n"]:
    """σ of `z = (R(turn) p + shift)_z`, given the covariance of turn and shift."""
    _, of_turn = cv2.Rodrigues(turn)
    of_row = np.asarray(of_turn)[:, 6:].reshape(3, 3)  # of R's third row, by turn
    J = np.hstack([positions @ of_row.T, np.tile([0.0, 0.0, 1.0], (len(positions), 1))])
    return np.sqrt(np.einsum("ni,ij,nj->n", J, covariance, J))


def as_summary(target: Target, sighting: TargetObservation) -> dict[str, Json]:
    """Return an entry of summary.json: lengths in metres, the target's frame in the first
    camera."""
    return {
        "points": [point.name for point in target.points],
        "pixels": sighting.pixels.tolist(),
        "depths": (1 / sighting.inverse_depths).tolist(),
        "reprojection_rms": sighting.rms,
        "T_camera_target": sighting.T_ct.tolist(),
    }
