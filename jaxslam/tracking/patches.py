"""Image patches: how a landmark looked when first seen, and how it would from elsewhere.

Positions are pixels (u, v) = (column, row), with pixel centres at whole numbers.
"""

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

Picture = UInt8[np.ndarray, "h w"]
"""A grey picture."""
Window = Float32[np.ndarray, "window window"]
"""The picture of a landmark as it should look now."""


WINDOW = 15  # side of the matched window in pixels, odd
STORED = 41  # side of the stored patch: room to warp the window by up to 41/15


@dataclass(frozen=True)
class Patch:
    """The neighbourhood of a landmark in the image where it was first seen.

    `pixel` (u, v) is where; `stored` is the grey patch sampled with that sub-pixel position in
    its very centre, float32 (`STORED`, `STORED`), of whose middle `WINDOW` pixels are matched.
    """

    pixel: Float[np.ndarray, " 2"]
    stored: Float32[np.ndarray, "stored stored"] = field(repr=False)

    @classmethod
    def take(cls, image: Picture, pixel: Float[np.ndarray, " 2"]) -> "Patch":
        """Cut out the patch around `pixel`; beyond the image's edge its last row or column
        repeats."""
        u, v = pixel.tolist()
        return cls(pixel, cv2.getRectSubPix(image, (STORED, STORED), (u, v), patchType=cv2.CV_32F))

    def covers(self, affine: Float[np.ndarray, "2 2"]) -> bool:
        """Return whether `warped` finds all it needs within the stored patch."""
        inverse = _inverse(affine)
        if inverse is None:
            return False
        reach = max(abs(inverse[0]) + abs(inverse[1]), abs(inverse[2]) + abs(inverse[3]))
        return reach * (WINDOW // 2) <= STORED // 2

    def warped(self, affine: Float[np.ndarray, "2 2"]) -> Window:
        """Return how the window looks after the image around the patch was mapped by `affine`.

        `affine` takes pixel offsets in the first image to those in the present one, so the
        result at offset x is the stored patch at affine^-1 x. Where the patch shrinks it is
        smoothed first. Raises `ValueError` for a singular map.
        """
        inverse = _inverse(affine)
        if inverse is None:
            raise ValueError("the affine map is singular; expected an invertible 2x2 matrix")
        a, b, c, d = inverse
        centre, middle = STORED // 2, WINDOW // 2
        stored = self.stored
        squares, determinant = a * a + b * b + c * c + d * d, a * d - b * c
        # The square of the inverse's largest singular value: how much the patch shrinks.
        shrink = 0.5 * (squares + math.sqrt(max(squares**2 - 4 * determinant**2, 0.0)))
        if shrink > 1.3**2:  # else too little to alias
            stored = cv2.GaussianBlur(stored, (0, 0), 0.5 * math.sqrt(shrink - 1.0))
        rows = [a, b, centre - (a + b) * middle], [c, d, centre - (c + d) * middle]
        size, flags = (WINDOW, WINDOW), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        map, border = np.array(rows, np.float64), cv2.BORDER_REPLICATE
        return cv2.warpAffine(stored, map, size, flags=flags, borderMode=border)


def _inverse(affine: Float[np.ndarray, "2 2"]) -> tuple[float, float, float, float] | None:
    """The inverse's four entries, row by row; None for a singular map or one not finite."""
    (a, b), (c, d) = np.asarray(affine, dtype=float).tolist()
    determinant = a * d - b * c
    if not math.isfinite(determinant) or abs(determinant) < 1e-6:
        return None
    return d / determinant, -b / determinant, -c / determinant, a / determinant
