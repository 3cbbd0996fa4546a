"""A camera's calibration, with its standard deviations, from pictures of a board."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from jaxslam._runtime.files import write_atomically
from jaxslam.io.board import Board, View
from jaxslam.io.calibration import INTRINSICS, Calibration, write_calibration
from jaxslam.io.opening import open_recording
from jaxslam.io.recording import Recording

VIEWS = 30
LEAST_VIEWS = 6
_CELLS = (10, 8)


@dataclass(frozen=True)
class Calibrated:
    """A calibration with its σ, and how it came about."""

    calibration: Calibration
    distortion_sigma: tuple[float, ...]
    rms: float
    """The RMS reprojection error, pixels."""
    views: tuple[View, ...]

    @property
    def coverage(self) -> float:
        """Share of the picture's cells in which a corner was."""
        return float(covered(self.views, self.calibration).mean())


def calibrate(
    source: str | Path, board: Board, progress: Callable[[int], None] = lambda pictures: None
) -> Calibrated:
    """The calibration of the camera that filmed `board`; any `open_source` layout is accepted.

    Raises ValueError where too few different views of the board are found.
    """
    recording = open_recording(source)
    if recording.clock is not None:
        raise ValueError(f"{recording.name} is a live camera; expected a video of a board")
    size, views = _views(recording, board, progress)
    chosen = different(views, size)
    if len(chosen) < LEAST_VIEWS:
        raise ValueError(
            f"{source}: {len(views)} pictures show the whole board of {board.columns}x{board.rows} "
            f"squares, of which {len(chosen)} are sharp and different; at least {LEAST_VIEWS} are "
            "needed"
        )
    return fitted(chosen, size)


def _views(
    recording: Recording, board: Board, progress: Callable[[int], None]
) -> tuple[tuple[int, int], list[View]]:
    """Width and height of the pictures, and the views of the board in them."""
    # The most pictures of a video in which the board is sought, spread over all of it.
    every = -(-len(recording.times) // 300)
    size, views = (0, 0), []
    for index, image in enumerate(recording.images()):
        progress(1)
        if index and image.shape[::-1] != size:
            raise ValueError(f"{recording.name}: picture {index} differs in size from the first")
        size = image.shape[::-1]
        view = board.find(image) if index % every == 0 else None
        views += [] if view is None else [view]
    return size, views


def different(views: Sequence[View], size: tuple[int, int], count: int = VIEWS) -> list[View]:
    """The sharp views, the sharpest first, then always the one that differs most from those."""
    if not views:
        return []
    # A view is sharp whose sharpness reaches this share of the median.
    enough = 0.7 * np.median([view.sharpness for view in views])
    rest = sorted((v for v in views if v.sharpness >= enough), key=lambda v: -v.sharpness)
    outlines = np.array([view.outline for view in rest]) / np.hypot(*size)
    chosen = [0]
    apart = _distance(outlines, outlines[0])
    # Views differ whose outlines are this share of the picture's diagonal apart (RMS).
    while len(chosen) < count and apart.max() > 0.02:
        chosen.append(int(np.argmax(apart)))
        apart = np.minimum(apart, _distance(outlines, outlines[chosen[-1]]))
    return [rest[place] for place in chosen]


def _distance(
    outlines: Float[np.ndarray, "n 4 2"], outline: Float[np.ndarray, "4 2"]
) -> Float[np.ndarray, " n"]:
    return np.sqrt(np.mean(np.sum((outlines - outline) ** 2, axis=2), axis=1))


def fitted(views: Sequence[View], size: tuple[int, int]) -> Calibrated:
    """OpenCV's least squares over intrinsics, distortion (k1, k2, p1, p2, k3) and poses.

    Its σ are those of corners with independent errors as large as the residuals are; views that
    fit far worse than the others are left out, once.
    """
    errors = _least_squares(views, size)[-1].ravel()
    # A view is left out whose error is so many times the median's.
    kept = [v for v, e in zip(views, errors, strict=True) if e <= 3.0 * np.median(errors)]
    rms, K, distortion, _, _, sigma, _, _ = _least_squares(kept, size)
    sigma = sigma.ravel().tolist()
    calibration = Calibration(
        *size, K[0, 0], K[1, 1], K[0, 2], K[1, 2], tuple(distortion.ravel()[:5].tolist()),
        sigma=tuple(sigma[:4]),
    )  # fmt: skip
    return Calibrated(calibration, tuple(sigma[4:9]), float(rms), tuple(kept))


def _least_squares(views: Sequence[View], size: tuple[int, int]) -> Any:
    points, pixels = [view.points for view in views], [view.pixels for view in views]
    unknown: Any = None
    return cv2.calibrateCameraExtended(points, pixels, size, unknown, unknown)


def covered(views: Iterable[View], calibration: Calibration) -> Bool[np.ndarray, "rows columns"]:
    """The cells of a grid over the picture that hold a corner."""
    cells = np.zeros(_CELLS[::-1], bool)
    for view in views:
        place = (view.pixels + 0.5) * _CELLS / (calibration.width, calibration.height)
        column, row = np.clip(place.astype(int), 0, np.array(_CELLS) - 1).T
        cells[row, column] = True
    return cells


def drawn_coverage(calibrated: Calibrated) -> UInt8[np.ndarray, "h w 3"]:
    """Every corner that was used, a colour a view; cells without any are dark."""
    camera = calibrated.calibration
    cells = np.where(covered(calibrated.views, camera), 255, 150).astype(np.uint8)
    size = (camera.width, camera.height)
    grey = cv2.resize(cells, size, interpolation=cv2.INTER_NEAREST)
    image = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    hues = np.linspace(0, 179, len(calibrated.views), endpoint=False)
    hsv = np.stack([hues, 0 * hues + 255, 0 * hues + 170], 1).astype(np.uint8)
    colours = cv2.cvtColor(hsv[None], cv2.COLOR_HSV2BGR)[0]
    for view, colour in zip(calibrated.views, colours.tolist(), strict=True):
        for x, y in np.rint(view.pixels).astype(int).tolist():
            cv2.circle(image, (x, y), max(2, camera.width // 320), colour, -1, cv2.LINE_AA)
    return image


def write(calibrated: Calibrated, board: Board, out: str | Path) -> None:
    """`calibration.json`, with σ and reprojection error, and `coverage.png`, into a folder."""
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    write_calibration(
        out / "calibration.json",
        calibrated.calibration,
        sigma={"distortion": list(calibrated.distortion_sigma)},
        reprojection_rms=calibrated.rms,
        views=len(calibrated.views),
        coverage=calibrated.coverage,
        board=asdict(board),
    )
    with write_atomically(out / "coverage.png") as path:
        cv2.imwrite(str(path), drawn_coverage(calibrated))


def describe(calibrated: Calibrated) -> str:
    """The calibration in a few lines."""
    camera = calibrated.calibration
    numbers = zip(INTRINSICS, camera.sigma, strict=True)
    told = ", ".join(f"{key} {getattr(camera, key):.2f} ± {sigma:.2f}" for key, sigma in numbers)
    return (
        f"{told}\n{len(calibrated.views)} views, reprojection error {calibrated.rms:.3f} px (RMS), "
        f"corners in {calibrated.coverage:.0%} of the picture"
    )
