"""The picture of active search over a video frame."""

import math
from functools import cache

import cv2
import numpy as np
from jaxtyping import Float, Int32, UInt8

from jaxslam._runtime.lookup import lookup
from jaxslam.io.source import Frame
from jaxslam.tracking.observations import Observations
from jaxslam.tracking.patches import Picture
from jaxslam.tracking.pose_with_covariance import Pixels
from jaxslam.tracking.report import Tracked

Lines = Float[np.ndarray, "k p 2"]
"""k lines of p pixels."""


# Okabe and Ito's colours, distinct to the colour-blind, as OpenCV's blue, green, red; and yet each
# status has a shape of its own.
COLOURS = {
    "matched": (115, 158, 0),  # bluish green
    "unmatched": (0, 159, 230),  # orange
    "outlier": (167, 121, 204),  # reddish purple
    "new": (233, 180, 86),  # sky blue
}
SIGMAS = 3.0  # the ellipses' size
LEAST_RADIUS = 4.0  # pixels, of an ellipse: a smaller one would not be seen
_WIDE, _FAINT = 40.0, 0.3  # pixels: wider ones, which all cross, are drawn so opaquely
ROW = 18  # height of the legend's rows below the image, in pixels
_SHIFT = 4  # OpenCV's drawing takes whole numbers: sixteenths of a pixel
_FONT, _LIGHT, _DARK = cv2.FONT_HERSHEY_SIMPLEX, (235, 235, 235), 20
_TURN, _DASH = 48, 4  # points on an ellipse, and on a dash or a gap of it
_CROSS = np.array([[[-4.0, -4.0], [4.0, 4.0]], [[-4.0, 4.0], [4.0, -4.0]]])
_SQUARE = np.array([[[-5.0, -5.0], [5.0, -5.0], [5.0, 5.0], [-5.0, 5.0], [-5.0, -5.0]]])
_SYMBOL, _GAP = 20, 8  # widths in the legend, pixels
_WIDEST = (
    "frame 12345  1234.56 s  map 12  unit open",
    "sigma: position 0.00123 units  0.123 deg  log scale 0.0123",
)
"""Notes as long as they become, for which there is room in the legend."""


def overlay_of(frame: Frame, result: Tracked) -> UInt8[np.ndarray, "h2 w 3"]:
    """The picture of what was sought, found and initialised in a frame."""
    table = result.observations.with_new(result.created)
    return draw_overlay(frame.image, table, _notes(result), _banner(result))


def _notes(result: Tracked) -> tuple[str, str]:
    """Return the frame's number, and the σ of its pose in the map's unit."""
    camera, log_scale = result.camera, result.sigma_log_scale
    degrees = math.degrees(camera.sigma_orientation)
    scale = "" if log_scale is None else f"  log scale {log_scale:.3g}"
    opening = "" if result.unit_fixed else "  unit open"
    return (
        f"frame {result.index}  {result.time:.2f} s  map {result.map}{opening}",
        f"sigma: position {camera.sigma_position:.3g} units  {degrees:.3g} deg{scale}",
    )


def _banner(result: Tracked) -> str:
    """Return the warnings of a frame: nothing while all is well."""
    if result.relocalised:
        return f"PLACE KNOWN AGAIN: MAP {result.map}"
    if result.loop is not None:
        return f"PLACE KNOWN AGAIN: SUBMAP {result.loop}"
    if result.starts:
        return f"LOST: MAP {result.map} BEGINS" if result.lost else ""
    return "" if result.state == "tracked" else result.state.upper()


def draw_overlay(
    image: Picture, table: Observations, notes: tuple[str, str] = ("", ""), banner: str = ""
) -> UInt8[np.ndarray, "h2 w 3"]:
    """The frame in blue, green, red with what the filter predicted and what was found there.

    Each landmark has the ellipse of three standard deviations around its predicted pixel, at least
    of `LEAST_RADIUS`. Its label, one of `COLOURS`, says what was found: a dot ('matched') or a
    cross ('outlier') with a line from the prediction, or a square ('new'). If it is 'unmatched',
    the ellipse is dashed and empty. What is not finite is not drawn. `banner` stands
    in large letters over the picture. Below it are two `notes`, ASCII, and a legend that counts the
    labels, in as many rows as the width asks for. Raises `ValueError` for another label.
    """
    lookup("label", [*COLOURS, *table.labels.tolist()], COLOURS)
    # Less contrast, so that the lines stand out.
    canvas = cv2.cvtColor(cv2.convertScaleAbs(image, alpha=0.75, beta=20), cv2.COLOR_GRAY2BGR)
    for label in COLOURS:
        _draw(canvas, label, *table.labelled(label)[1:4])
    if banner:
        _draw_banner(canvas, banner)
    counts = {label: len(table.labelled(label).slots) for label in COLOURS}
    return np.vstack([canvas, _legend(image.shape[1], notes, counts)])


def overlay_size(width: int, height: int) -> tuple[int, int]:
    """Width and height in pixels of what `draw_overlay` makes of an image of this size."""
    return width, height + ROW * _rows(width)


def _draw(
    canvas: UInt8[np.ndarray, "h w 3"],
    status: str,
    predicted: Pixels,
    covariances: Float[np.ndarray, "k 2 2"],
    matched: Pixels,
) -> None:
    """Draw k landmarks of one label."""
    expected, found = np.isfinite(predicted).all(axis=1), np.isfinite(matched).all(axis=1)
    shaped = expected & np.isfinite(covariances).all(axis=(1, 2))
    ellipses = search_ellipses(predicted[shaped], covariances[shaped])
    radii = np.linalg.norm(ellipses - predicted[shaped, None], axis=2).max(axis=1, initial=0.0)
    for draw, some in ((_draw_faintly, radii > _WIDE), (_draw_lines, radii <= _WIDE)):
        lines = ellipses[some]
        draw(canvas, _dashes(lines) if status == "unmatched" else lines, status)
    _draw_lines(canvas, np.stack([predicted, matched], axis=1)[expected & found], status)
    _draw_marks(canvas, matched[found], status)


def _draw_marks(canvas: UInt8[np.ndarray, "h w 3"], pixels: Pixels, status: str) -> None:
    """Mark where landmarks were found."""
    if status in ("outlier", "new"):
        shape = _CROSS if status == "outlier" else _SQUARE
        _draw_lines(canvas, (pixels[:, None, None] + shape).reshape(-1, *shape.shape[1:]), status)
    else:
        for pixel in _fixed(pixels).tolist():
            cv2.circle(canvas, pixel, 2 << _SHIFT, COLOURS[status], -1, cv2.LINE_AA, _SHIFT)


def search_ellipses(centres: Pixels, covariances: Float[np.ndarray, "k 2 2"]) -> Lines:
    """Closed lines of p points around the centres, three standard deviations away."""
    variances, axes = np.linalg.eigh(covariances)
    radii = np.clip(SIGMAS * np.sqrt(np.maximum(variances, 0.0)), LEAST_RADIUS, 2000.0)
    angles = np.linspace(0, 2 * np.pi, _TURN + 1)
    circle = np.stack([np.cos(angles), np.sin(angles)])
    return centres[:, None] + np.swapaxes((axes * radii[:, None]) @ circle, 1, 2)


def _dashes(lines: Lines) -> Float[np.ndarray, "d q 2"]:
    """Every other piece of each."""
    return lines[:, :_TURN].reshape(-1, _TURN // _DASH, _DASH, 2)[:, ::2].reshape(-1, _DASH, 2)


def _draw_lines(canvas: UInt8[np.ndarray, "h w 3"], lines: Lines, status: str) -> None:
    """Draw lines with a dark seam, so that they stand out on what is bright too."""
    fixed = list(_fixed(lines))
    cv2.polylines(canvas, fixed, False, (0, 0, 0), 3, cv2.LINE_8, _SHIFT)
    cv2.polylines(canvas, fixed, False, COLOURS[status], 1, cv2.LINE_AA, _SHIFT)


def _draw_faintly(canvas: UInt8[np.ndarray, "h w 3"], lines: Lines, status: str) -> None:
    """Draw thin lines through which the picture is seen."""
    if not len(lines):
        return
    over = canvas.copy()
    cv2.polylines(over, list(_fixed(lines)), False, COLOURS[status], 1, cv2.LINE_AA, _SHIFT)
    cv2.addWeighted(over, _FAINT, canvas, 1 - _FAINT, 0, dst=canvas)


def _fixed(pixels: Float[np.ndarray, "*k 2"]) -> Int32[np.ndarray, "*k 2"]:
    return np.rint(np.clip(pixels, -2000, 20000) * 2**_SHIFT).astype(np.int32)


def _draw_banner(canvas: UInt8[np.ndarray, "h w 3"], text: str) -> None:
    """Large letters on a dark band at the top."""
    height, width = canvas.shape[:2]
    across, up = cv2.getTextSize(text, _FONT, 1.0, 2)[0]
    scale = min(0.9 * width / across, height / 11 / up)
    band = canvas[: round(height / 6)]
    band //= 4
    place = round((width - scale * across) / 2), round((len(band) + scale * up) / 2)
    cv2.putText(canvas, text, place, _FONT, scale, _LIGHT, max(1, round(2 * scale)), cv2.LINE_AA)


def _legend(
    width: int, notes: tuple[str, str], counts: dict[str, int]
) -> UInt8[np.ndarray, "strip w 3"]:
    strip = np.full((ROW * _rows(width), width, 3), _DARK, np.uint8)
    places = _places(width)
    for note, (x, y) in zip(notes, places, strict=False):
        _write(strip, note, x, y)
    for (status, count), (x, y) in zip(counts.items(), places[len(notes) :], strict=True):
        _draw_symbol(strip, status, x, y)
        _write(strip, f"{count} {status}", x + _SYMBOL, y)
    return strip


def _draw_symbol(strip: UInt8[np.ndarray, "strip w 3"], status: str, x: int, y: int) -> None:
    """Draw what a landmark of this status looks like."""
    centre, nothing = np.array([[x + 7.0, y]]), np.full((1, 2), np.nan)
    away = {"matched": 2.0, "outlier": 5.0, "new": 0.0}
    found = centre + np.array([away[status], 0.0]) if status in away else nothing
    covariance = np.eye(2)[None] * (6.0 / SIGMAS) ** 2
    _draw(strip, status, nothing if status == "new" else centre, covariance, found)


def _write(strip: UInt8[np.ndarray, "strip w 3"], text: str, x: int, y: int) -> None:
    scale = _letters(strip.shape[1])
    cv2.putText(strip, text, (x, y + round(11 * scale)), _FONT, scale, _LIGHT, 1, cv2.LINE_AA)


def _letters(width: int) -> float:
    """Smaller letters under a narrow image, though none that cannot be read if they fit."""
    widest = max(cv2.getTextSize(text, _FONT, 1.0, 1)[0][0] for text in _WIDEST)
    return min(max(width / 1400, 0.36), 0.45, (width - _GAP) / widest)


def _rows(width: int) -> int:
    return 1 + _places(width)[-1][1] // ROW


@cache
def _places(width: int) -> list[tuple[int, int]]:
    """Left end and middle of the notes and of the statuses, the first of which begins a row."""
    widest = [(text, 0) for text in _WIDEST] + [(f"00 {name}", _SYMBOL) for name in COLOURS]
    places, x, y = [], 4, ROW // 2
    for text, before in widest:
        wide = before + cv2.getTextSize(text, _FONT, _letters(width), 1)[0][0] + _GAP
        if places and (x + wide > width or len(places) == len(_WIDEST)):
            x, y = 4, y + ROW
        places.append((x, y))
        x += wide
    return places
