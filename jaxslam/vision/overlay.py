"""The picture of active search over a video frame, and the video file of such pictures."""

import os
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
from jaxtyping import Float, UInt8

# Okabe and Ito's colours, distinct to the colour-blind, as OpenCV's blue, green, red.
COLOURS = {
    "matched": (115, 158, 0),  # bluish green
    "unmatched": (0, 159, 230),  # orange
    "outlier": (167, 121, 204),  # reddish purple
    "new": (233, 180, 86),  # sky blue
}
SIGMAS = 3.0  # the ellipses' size
STRIP = 24  # height of the legend's strip below the image, in pixels
_SHIFT = 4  # OpenCV's drawing takes whole numbers: sixteenths of a pixel
_KEY = "+ predicted, 3 sigma; . found"
_FONT, _TEXT = cv2.FONT_HERSHEY_SIMPLEX, 0.4


def draw_overlay(
    image: UInt8[np.ndarray, "h w"],
    *,
    predicted: Float[np.ndarray, "n 2"],
    covariances: Float[np.ndarray, "n 2 2"],
    matched: Float[np.ndarray, "n 2"],
    status: Sequence[str],
    index: int | None = None,
    time: float | None = None,
    note: str = "",
) -> UInt8[np.ndarray, "h2 w 3"]:
    """The frame in blue, green, red with what the filter predicted and what was found there.

    For each of n landmarks: a small cross at the `predicted` pixel (u, v), the ellipse of three
    standard deviations of its 2x2 covariance (pixels^2), and a ring with a line to it at the
    `matched` pixel, in the colour of its status, one of `COLOURS`. What is not finite is not
    drawn: nan for a landmark without a match, or without a prediction ('new'). Below the image
    a strip of `STRIP` rows counts the statuses and gives `index`, `time` (s) and a short `note`.
    Raises `ValueError` for another status.
    """
    unknown = sorted({str(name) for name in status} - set(COLOURS))
    if unknown:
        raise ValueError(f"status {unknown[0]!r} is unknown; {', '.join(COLOURS)} are accepted")
    # Less contrast, so that the lines stand out.
    canvas = cv2.cvtColor(cv2.convertScaleAbs(image, alpha=0.75, beta=20), cv2.COLOR_GRAY2BGR)
    for centre, covariance, found, name in zip(
        predicted, covariances, matched, status, strict=True
    ):
        colour = COLOURS[str(name)]
        if np.all(np.isfinite(centre)):
            _draw_prediction(canvas, centre, covariance, colour)
        if np.all(np.isfinite(found)):
            _draw_match(canvas, centre, found, colour)
    return np.vstack([canvas, _legend(image.shape[1], status, index, time, note)])


class OverlayWriter:
    """An MP4 file written frame by frame, complete at any end of the `with` block.

    Frames go to a temporary name beside `path`, which becomes `path` when the block ends, by an
    exception or an interruption too; without a single frame nothing is left. `size` is width
    and height in pixels of the frames to come (MP4 drops the last row or column of an odd one),
    `rate` in 1/s. Raises `ValueError` where the
    file cannot be opened or a frame has another size.
    """

    def __init__(self, path: str | Path, size: tuple[int, int], rate: float) -> None:
        self.path = Path(path)
        self.size = size
        self.rate = rate
        self.frames = 0
        if self.path.suffix.lower() != ".mp4":
            raise ValueError(f"{self.path}: a name ending in .mp4 is accepted")
        self._temporary = self.path.with_name(f".{os.getpid()}.{self.path.name}")

    def __enter__(self) -> "OverlayWriter":
        fourcc = cv2.VideoWriter.fourcc(*"mp4v")
        self._writer = cv2.VideoWriter(str(self._temporary), fourcc, self.rate, self.size)
        if not self._writer.isOpened():
            self._temporary.unlink(missing_ok=True)
            raise ValueError(
                f"{self.path}: cannot be opened as an MP4 video of {self.size[0]}x{self.size[1]} "
                f"at {self.rate} frames/s"
            )
        return self

    def write(self, frame: UInt8[np.ndarray, "h w 3"]) -> None:
        """Append a frame, as `draw_overlay` returns it."""
        if frame.shape != (self.size[1], self.size[0], 3):  # OpenCV would drop it silently
            raise ValueError(
                f"{self.path}: a frame of shape {frame.shape} does not fit a video of "
                f"{self.size[0]}x{self.size[1]} in colour"
            )
        self._writer.write(frame)
        self.frames += 1

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._writer.release()
        if self.frames:
            self._temporary.replace(self.path)
        else:
            self._temporary.unlink(missing_ok=True)


def overlay_size(width: int, height: int) -> tuple[int, int]:
    """Width and height in pixels of what `draw_overlay` makes of an image of this size."""
    return width, height + STRIP


def _fixed(value: Float[np.ndarray, " 2"]) -> tuple[int, int]:
    x, y = np.rint(np.clip(value, -2000, 20000) * 2**_SHIFT).astype(int)
    return int(x), int(y)


def _draw_prediction(
    canvas: UInt8[np.ndarray, "h w 3"],
    centre: Float[np.ndarray, " 2"],
    covariance: Float[np.ndarray, "2 2"],
    colour: tuple[int, int, int],
) -> None:
    for arm in ((3.0, 0.0), (0.0, 3.0)):
        ends = _fixed(centre - arm), _fixed(centre + arm)
        cv2.line(canvas, *ends, colour, 1, cv2.LINE_AA, _SHIFT)
    if not np.all(np.isfinite(covariance)):
        return
    variances, axes = np.linalg.eigh(covariance)
    radii = np.minimum(SIGMAS * np.sqrt(np.maximum(variances, 0.0)), 2000.0)
    angle = float(np.degrees(np.arctan2(axes[1, 1], axes[0, 1])))
    long, short = _fixed(radii[::-1])
    cv2.ellipse(
        canvas, _fixed(centre), (long, short), angle, 0, 360, colour, 1, cv2.LINE_AA, _SHIFT
    )


def _draw_match(
    canvas: UInt8[np.ndarray, "h w 3"],
    centre: Float[np.ndarray, " 2"],
    found: Float[np.ndarray, " 2"],
    colour: tuple[int, int, int],
) -> None:
    if np.all(np.isfinite(centre)):
        cv2.line(canvas, _fixed(centre), _fixed(found), colour, 1, cv2.LINE_AA, _SHIFT)
    else:  # a wider ring, as there is no ellipse to catch the eye
        cv2.circle(canvas, _fixed(found), 6 << _SHIFT, colour, 1, cv2.LINE_AA, _SHIFT)
    cv2.circle(canvas, _fixed(found), 2 << _SHIFT, colour, -1, cv2.LINE_AA, _SHIFT)


def _legend(
    width: int, status: Sequence[str], index: int | None, time: float | None, note: str
) -> UInt8[np.ndarray, "strip w 3"]:
    strip = np.full((STRIP, width, 3), 20, np.uint8)
    names = [str(name) for name in status]
    place = "" if index is None else f"frame {index}"
    place += "" if time is None else f"  {time:.2f} s"
    place += f"  {note}" if note else ""
    entries = [(place.strip(), None)] if place else []
    entries += [(f"{names.count(name)} {name}", colour) for name, colour in COLOURS.items()]
    # A narrow image gets smaller letters, a wide one does not get larger ones.
    scale = _TEXT * min(1.0, width / 560)
    x, baseline = round(20 * scale), STRIP // 2 + round(11 * scale)
    for text, colour in entries:
        if colour is not None:
            cv2.circle(strip, (x + 4, STRIP // 2), 4, colour, -1, cv2.LINE_AA)
            x += 13
        cv2.putText(strip, text, (x, baseline), _FONT, scale, (235, 235, 235), 1, cv2.LINE_AA)
        x += cv2.getTextSize(text, _FONT, scale, 1)[0][0] + round(35 * scale)
    if x + cv2.getTextSize(_KEY, _FONT, scale, 1)[0][0] < width:
        cv2.putText(strip, _KEY, (x, baseline), _FONT, scale, (170, 170, 170), 1, cv2.LINE_AA)
    return strip
