"""Boards that calibrate a camera: what they look like, and where a picture shows their corners."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from jaxslam._runtime.lookup import lookup

KINDS = ("checkerboard", "charuco")
_AROUND = 9
"""Side of the neighbourhood of a corner, pixels, in which its edges are looked at."""


class View(NamedTuple):
    """k corners of a board in one picture."""

    pixels: Float32[np.ndarray, "k 2"]
    points: Float32[np.ndarray, "k 3"]
    """Where they are on the board, m; z is 0."""
    outline: Float[np.ndarray, "4 2"]
    """Pixels of the board's four outer corners."""
    sharpness: float
    """Slope of the edges at the corners, in their contrasts a pixel: 1/2 for a perfect one."""


@dataclass(frozen=True)
class Board:
    """A board of squares across and down, counted on the paper, of side `square`, m.

    A `charuco` board has a marker of `dictionary` in every white square, so that part of it is
    enough. Raises ValueError for what is no board.
    """

    kind: str = "checkerboard"
    columns: int = 10
    rows: int = 7
    square: float = 0.025
    dictionary: str = "5X5_100"

    def __post_init__(self) -> None:
        lookup("board", [self.kind], dict.fromkeys(KINDS))
        if min(self.columns, self.rows) < 4:
            raise ValueError(
                f"a board must have at least 4x4 squares, not {self.columns}x{self.rows}"
            )
        if not 0 < self.square < np.inf:
            raise ValueError(f"square must be a positive length, not {self.square} m")
        if not hasattr(cv2.aruco, f"DICT_{self.dictionary}"):
            raise ValueError(
                f"unknown dictionary {self.dictionary!r}; known: 4X4_50, 5X5_100, 6X6_250 and "
                "OpenCV's others"
            )

    @property
    def corners(self) -> Float32[np.ndarray, "n 3"]:
        """The points where four squares meet, row by row, m."""
        y, x = np.mgrid[1 : self.rows, 1 : self.columns]
        points = self.square * np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
        return points.astype(np.float32)

    @cached_property
    def _detector(self) -> cv2.aruco.CharucoDetector:
        number = getattr(cv2.aruco, f"DICT_{self.dictionary}")
        dictionary = cv2.aruco.getPredefinedDictionary(number)
        size = (self.columns, self.rows)
        # Side of a ChArUco marker, in squares.
        board = cv2.aruco.CharucoBoard(size, self.square, 0.75 * self.square, dictionary)
        return cv2.aruco.CharucoDetector(board)

    def drawn(self, pixels: int = 100) -> UInt8[np.ndarray, "h w"]:
        """The board to print, a square of so many pixels, with a white margin of one square."""
        size = (self.columns * pixels, self.rows * pixels)
        if self.kind == "charuco":
            board = self._detector.getBoard().generateImage(size)
        else:
            dark = np.add.outer(np.arange(self.rows), np.arange(self.columns)) % 2 == 0
            board = np.kron(np.where(dark, 0, 255), np.ones((pixels, pixels))).astype(np.uint8)
        return np.pad(board, pixels, constant_values=255)

    def find(self, image: UInt8[np.ndarray, "h w"]) -> View | None:
        """The board in a picture; None where too little of it is seen."""
        find = self._find_charuco if self.kind == "charuco" else self._find_checkerboard
        pixels, points = find(image)
        if len(pixels) < 8 or np.linalg.matrix_rank(points - points[0]) < 2:
            return None
        outline = self._outline(pixels, points)
        if outline is None:
            return None
        return View(pixels, points, outline, sharpness(image, pixels))

    def _find_checkerboard(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        size = (self.columns - 1, self.rows - 1)
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
        found, pixels = cv2.findChessboardCornersSB(image, size, flags=flags)
        if not found:
            return _NOTHING
        return self._refined(image, pixels), self.corners

    def _refined(self, image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        """The saddles of the grey levels: three times as exact as where they were detected."""
        grid = pixels.reshape(self.rows - 1, self.columns - 1, 2)
        apart = min(np.linalg.norm(np.diff(grid, axis=a), axis=2).min() for a in (0, 1))
        # To each side of a corner, in the least distance of two, in which it is refined.
        reach = int(np.clip(0.3 * apart, 2, 10))
        end = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
        return cv2.cornerSubPix(image, pixels, (reach, reach), (-1, -1), end).reshape(-1, 2)

    def _find_charuco(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pixels, numbers, *_ = self._detector.detectBoard(image)
        return _NOTHING if numbers is None else (
            pixels.reshape(-1, 2), self.corners[np.ravel(numbers).astype(int)]
        )  # fmt: skip

    def _outline(self, pixels: np.ndarray, points: np.ndarray) -> np.ndarray | None:
        """The outline of the whole board, by the homography of the corners seen."""
        H, _ = cv2.findHomography(points[:, :2], pixels)
        if H is None:
            return None
        ends = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * (self.columns, self.rows)
        there = np.column_stack([self.square * ends, np.ones(4)]) @ H.T
        return there[:, :2] / there[:, 2:]


_NOTHING = np.zeros((0, 2), np.float32), np.zeros((0, 3), np.float32)


def sharpness(image: UInt8[np.ndarray, "h w"], pixels: Float32[np.ndarray, "k 2"]) -> float:
    """The median over corners of the steepest slope beside one, over the contrast there."""
    across, down = cv2.spatialGradient(image)
    slope = np.hypot(across, down, dtype=np.float32) / 8  # Sobel's kernel counts a step 8 times
    window = np.ones((_AROUND, _AROUND), np.uint8)
    contrast = cv2.dilate(image, window).astype(np.float32) - cv2.erode(image, window)
    x, y = np.clip(np.rint(pixels).astype(int), 0, np.array(image.shape[::-1]) - 1).T
    return float(np.median(cv2.dilate(slope, window)[y, x] / np.maximum(contrast[y, x], 1.0)))
