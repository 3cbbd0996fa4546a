"""A small ray caster: pictures of boxes and spheres with procedural textures, anti-aliased.

Boxes turned about the vertical and spheres are hit exactly; a room is a box seen from inside.
Textures are periodic pictures on the faces (a sphere has those of its cube), with a pyramid of
levels against aliasing. Axes are a camera's: x to the right, y down, z forward.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from jaxslam.io.calibration import Calibration
from jaxslam.io.source import Image

SIZE = 512
"""Texels of a texture, which repeats."""
MATERIALS = ("mosaic", "cells", "blots", "checker")
_NEAR = 0.02
"""Metres: what is nearer to the plane of the camera is not seen."""
_LIGHT = (0.25, 0.15, 0.0)
"""How much darker a face across x, y, z is."""

Vector = Sequence[float] | Float[np.ndarray, " 3"]


class Paint(NamedTuple):
    """What a body's faces look like."""

    material: int = 0
    base: float = 130.0
    """The mean grey level."""
    contrast: float = 80.0
    """The texture's largest difference from that."""
    density: float = 100.0
    """Texels a metre."""
    shift: tuple[float, float] = (0.0, 0.0)
    """Of the texture, in texels."""


class Body(NamedTuple):
    """A box or a sphere."""

    centre: Vector
    """In metres."""
    half: Vector
    """Half the edges in metres; of a sphere, its radius three times."""
    paint: Paint = Paint()
    yaw: float = 0.0
    """Of the box about the vertical, rad."""
    sphere: bool = False


def to_body(body: Body) -> Float[np.ndarray, "3 3"]:
    """The rotation from the world's axes to the body's."""
    return Rotation.from_rotvec([0.0, -body.yaw, 0.0]).as_matrix()


def render(
    bodies: list[Body],
    T_wc: Float[np.ndarray, "4 4"],
    calibration: Calibration,
    sky: float = 245.0,
    samples: int = 2,
) -> Float[np.ndarray, "h w"]:
    """The picture seen from `T_wc`, in grey levels: the mean of samples² rays a pixel.

    `sky` is the grey level where no body is. The centre of pixel (u, v) is at (u, v).
    """
    (w, h), n = (calibration.width, calibration.height), samples
    x = ((np.arange(n * w) + 0.5) / n - 0.5 - calibration.cx) / calibration.fx
    y = ((np.arange(n * h) + 0.5) / n - 0.5 - calibration.cy) / calibration.fy
    rays = x.astype(np.float32), y.astype(np.float32)
    depth = np.full((n * h, n * w), np.inf, np.float32)
    owner = np.full(depth.shape, -1, np.int16)
    parts = [_part(body, T_wc, calibration, n) for body in bodies]
    for number, (body, part) in enumerate(zip(bodies, parts, strict=True)):
        if part is not None:
            t = _hit(body, T_wc, rays[0][part[1]], rays[1][part[0]])
            nearer = t < depth[part]
            depth[part][nearer] = t[nearer]
            owner[part][nearer] = number
    grey = np.full(depth.shape, sky, np.float32)
    for number, (body, part) in enumerate(zip(bodies, parts, strict=True)):
        if part is not None:
            row, column = np.nonzero(owner[part] == number)
            if len(row):
                t = depth[part][row, column]
                seen = rays[0][part[1]][column], rays[1][part[0]][row], t
                grey[part][row, column] = _shade(body, T_wc, seen, n * calibration.fx)
    return cv2.resize(grey, (w, h), interpolation=cv2.INTER_AREA)


def as_image(grey: Float[np.ndarray, "h w"]) -> Image:
    """Rounded and clipped to 0..255."""
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def _part(body: Body, T_wc, calibration: Calibration, n: int) -> tuple[slice, slice] | None:
    """Rows and columns of rays that may hit the body; None where none does."""
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    corners = signs * np.asarray(body.half) @ to_body(body) + np.asarray(body.centre)
    x, y, z = ((corners - T_wc[:3, 3]) @ T_wc[:3, :3]).T
    if z.max() < _NEAR:
        return None
    if z.min() < _NEAR:
        return slice(None), slice(None)
    u, v = calibration.fx * x / z + calibration.cx, calibration.fy * y / z + calibration.cy
    (left, right), (top, bottom) = (
        (max(int(n * p.min()) - n, 0), min(int(n * p.max()) + 2 * n, n * size))
        for p, size in ((u, calibration.width), (v, calibration.height))
    )
    return None if left >= right or top >= bottom else (slice(top, bottom), slice(left, right))


def _hit(body: Body, T_wc, x, y) -> Float[np.ndarray, "h w"]:
    """Depths z at which rays (x, y, 1) enter the body, or leave it where the camera is inside;
    infinite where they do not."""
    turn = to_body(body)
    start = (turn @ (T_wc[:3, 3] - np.asarray(body.centre))).astype(np.float32)
    across, down, ahead = (turn @ T_wc[:3, :3]).astype(np.float32).T
    ways = [(across[k] * x + ahead[k])[None] + (down[k] * y)[:, None] for k in range(3)]
    with np.errstate(divide="ignore", invalid="ignore"):
        if body.sphere:
            a = sum(way * way for way in ways)
            b = sum(s * way for s, way in zip(start, ways, strict=True))
            root = b * b - a * np.float32(start @ start - body.half[0] ** 2)
            t = np.where(root >= 0, (-b - np.sqrt(root)) / a, np.inf)
            return np.where(t > _NEAR, t, np.float32(np.inf))
        near, far = np.float32(-np.inf), np.float32(np.inf)
        for s, half, way in zip(start, body.half, ways, strict=True):
            middle, reach = -s / way, np.abs(np.float32(half) / way)
            near, far = np.maximum(near, middle - reach), np.minimum(far, middle + reach)
    t = np.where(near > _NEAR, near, far)
    return np.where((near < far) & (far > _NEAR), t, np.float32(np.inf))


def _shade(body: Body, T_wc, seen, focal: float) -> Float[np.ndarray, " n"]:
    """Grey levels of the places that rays (x, y, 1) hit at depths t."""
    x, y, t = seen
    paint, turn = body.paint, to_body(body)
    way = np.stack([x, y, np.ones_like(x)]).T @ (turn @ T_wc[:3, :3]).T.astype(np.float32)
    place = (turn @ (T_wc[:3, 3] - np.asarray(body.centre))).astype(np.float32) + t[:, None] * way
    share = place / np.array(body.half, np.float32)
    face = np.argmax(np.abs(share), axis=1)
    rows = np.arange(len(face))
    normal = share[rows, face] > 0
    u, v = place[rows, (face + 1) % 3], place[rows, (face + 2) % 3]
    length = np.linalg.norm(way, axis=1)
    facing = np.abs(way[rows, face]) if not body.sphere else np.abs(np.sum(way * share, axis=1))
    # Between the finest and the coarsest direction of the footprint; the rays' mean does the rest.
    width = t * length**1.5 / (focal * np.sqrt(np.maximum(facing, 0.02 * length)))
    corner = paint.shift + (2 * face + normal)[:, None] * np.array([137.0, 211.0])
    texel = paint.density * np.stack([u, v], 1) + corner
    level = np.log2(np.maximum(paint.density * width, 1e-6))
    light = 1 - np.array(_LIGHT, np.float32)[face]
    return (paint.base + paint.contrast * _sampled(paint.material, texel, level)) * light


def _sampled(material: int, texel, level) -> Float[np.ndarray, " n"]:
    """Values in −1 … 1 of a texture between its levels."""
    atlas, lefts = _atlas()
    level = np.clip(level, 0, len(lefts) - 1.001)
    lower = level.astype(np.intp)
    values = []
    for number in (lower, lower + 1):
        scale = np.exp2(-number.astype(np.float32))[:, None]
        at = np.mod(texel * scale - 0.5, SIZE * scale).astype(np.float32)
        at += np.stack([lefts[number], np.full(len(number), material * (SIZE + 1))], 1)
        # Remapped in rows of a length that OpenCV takes.
        x, y = np.pad(at, ((0, -len(at) % 1024), (0, 0))).T.reshape(2, -1, 1024)
        found = cv2.remap(atlas, x, y, cv2.INTER_LINEAR)
        values.append(found.reshape(-1)[: len(at)])
    part = level - lower
    return (1 - part) * values[0] + part * values[1]


@cache
def _atlas() -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, " levels"]]:
    """All levels of all materials beside each other, each with its first row and column again
    behind the last, and the columns at which the levels begin."""
    rows, sizes = [], [SIZE >> level for level in range(7)]
    for number in range(len(MATERIALS)):
        image, row = texture(number), []
        for size in sizes:
            image = cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA)
            below = ((0, SIZE - size), (0, 0))
            row.append(np.pad(np.pad(image, ((0, 1), (0, 1)), mode="wrap"), below))
        rows.append(np.hstack(row))
    lefts = np.concatenate([[0], np.cumsum(np.array(sizes) + 1)[:-1]])
    return np.vstack(rows), lefts.astype(np.float32)


def texture(material: int) -> Float[np.ndarray, "h w"]:
    """A periodic texture in −1 … 1 with sharp edges, smoothed over about one texel."""
    rng = np.random.default_rng([material, 7])
    soft = sum(
        share * _noise(rng, sigma) for share, sigma in ((0.5, 40.0), (0.3, 12.0), (0.2, 4.0))
    )
    i, j = np.mgrid[:SIZE, :SIZE]
    if MATERIALS[material] == "mosaic":  # tiles of two sizes, with joints
        tiles = rng.uniform(-1, 1, (16, 16)).repeat(32, 0).repeat(32, 1)
        small = rng.uniform(-1, 1, (64, 64)).repeat(8, 0).repeat(8, 1)
        sharp = np.where(_noise(rng, 30.0) > 0.3, small, tiles)
        sharp[((i % 32) < 2) | ((j % 32) < 2)] = -1
    elif MATERIALS[material] == "cells":
        tree = KDTree(rng.uniform(0, SIZE, (400, 2)), boxsize=SIZE)
        _, cell = tree.query(np.stack([i, j], -1).reshape(-1, 2))
        sharp = rng.uniform(-1, 1, 400)[cell].reshape(i.shape)
    elif MATERIALS[material] == "blots":
        sharp = np.sign(_noise(rng, 7.0)) * 0.5 + np.sign(_noise(rng, 3.5) - 0.4) * 0.5
    else:
        sharp = np.where((i // 32 + j // 32) % 2, 0.8, -0.8)
    values = np.clip(0.75 * sharp + 0.35 * soft, -1, 1).astype(np.float32)
    wide = cv2.GaussianBlur(np.pad(values, 8, mode="wrap"), (0, 0), 0.8)
    return wide[8:-8, 8:-8]


def _noise(rng: np.random.Generator, sigma: float) -> Float[np.ndarray, "h w"]:
    """Periodic noise of standard deviation 1, smooth over `sigma` texels."""
    frequency = np.fft.fftfreq(SIZE)
    fall = np.exp(-2 * (np.pi * sigma * frequency) ** 2)
    spectrum = np.fft.fft2(rng.standard_normal((SIZE, SIZE))) * fall * fall[:, None]
    spectrum[0, 0] = 0
    noise = np.fft.ifft2(spectrum).real
    return noise / noise.std()
