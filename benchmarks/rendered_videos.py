"""Rendered videos with what real ones have, and their exact truth (`KINDS`), by a ray caster.

Boxes turned about the vertical and spheres are hit exactly; a room is a box seen from inside.
Textures are periodic pictures on the faces (a sphere has those of its cube), with a pyramid of
levels against aliasing. Axes are a camera's: x to the right, y down, z forward.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from jaxslam._runtime.files import write_atomically
from jaxslam.io.calibration import Calibration, from_field_of_view
from jaxslam.io.source import Image, Source, Trajectory
from jaxslam.tracking.optics import rays
from jaxslam.tracking.synthetic import add_noise

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
    rays, coarse = _rays(calibration, n)
    depth = np.full((n * h, n * w), np.inf, np.float32)
    owner = np.full(depth.shape, -1, np.int16)
    parts = [_part(body, T_wc, coarse) for body in bodies]
    for number, (body, part) in enumerate(zip(bodies, parts, strict=True)):
        if part is not None:
            t = _hit(body, T_wc, rays[part])
            nearer = t < depth[part]
            depth[part][nearer] = t[nearer]
            owner[part][nearer] = number
    grey = np.full(depth.shape, sky, np.float32)
    for number, (body, part) in enumerate(zip(bodies, parts, strict=True)):
        if part is not None:
            row, column = np.nonzero(owner[part] == number)
            if len(row):
                seen = rays[part][row, column], depth[part][row, column]
                grey[part][row, column] = _shade(body, T_wc, *seen, n * calibration.fx)
    return cv2.resize(grey, (w, h), interpolation=cv2.INTER_AREA)


def as_image(grey: Float[np.ndarray, "h w"]) -> Image:
    """Rounded and clipped to 0..255."""
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


_APART = 8
"""Rays from one to the next of those that tell which may hit a body."""


@cache
def _rays(calibration: Calibration, n: int) -> tuple[Float[np.ndarray, "h w 3"], np.ndarray]:
    """The rays of n² samples a pixel, by the lens; and some of them, of unit length."""
    v, u = (np.mgrid[: n * calibration.height, : n * calibration.width] + 0.5) / n - 0.5
    found = rays(calibration, np.stack([u.ravel(), v.ravel()], 1)).astype(np.float32)
    found = found.reshape(*u.shape, 3)
    coarse = found[::_APART, ::_APART]
    return found, coarse / np.linalg.norm(coarse, axis=2, keepdims=True)


def _part(body: Body, T_wc, coarse: Float[np.ndarray, "h w 3"]) -> tuple[slice, slice] | None:
    """Rows and columns of rays that may hit the body; None where none does."""
    to_centre = (np.asarray(body.centre) - T_wc[:3, 3]) @ T_wc[:3, :3]
    away = np.linalg.norm(to_centre)
    reach = float(np.linalg.norm(body.half)) if not body.sphere else body.half[0]
    if reach >= away:
        return slice(None), slice(None)
    apart = np.arccos(np.sum(coarse[:-1] * coarse[1:], axis=2).min())
    least = np.cos(min(np.arcsin(reach / away) + 1.5 * apart, np.pi))
    near = coarse @ (to_centre / away).astype(np.float32) >= least
    if not near.any():
        return None
    rows, columns = (np.flatnonzero(near.any(axis=axis)) for axis in (1, 0))
    return _around(rows), _around(columns)


def _around(hit: Int[np.ndarray, " n"]) -> slice:
    """The pixels about the coarse rays from the first that hits to the last."""
    return slice(max(int(hit[0]) - 1, 0) * _APART, (int(hit[-1]) + 2) * _APART)


def _hit(body: Body, T_wc, rays: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    """In how many times their length rays enter the body, or leave it where the camera is inside;
    infinite where they do not."""
    turn = to_body(body)
    start = (turn @ (T_wc[:3, 3] - np.asarray(body.centre))).astype(np.float32)
    ways = np.moveaxis(rays @ (turn @ T_wc[:3, :3]).T.astype(np.float32), 2, 0)
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


def _shade(body: Body, T_wc, rays, t, focal: float) -> Float[np.ndarray, " n"]:
    """Grey levels of the places that rays hit in t times their length."""
    paint, turn = body.paint, to_body(body)
    way = rays @ (turn @ T_wc[:3, :3]).T.astype(np.float32)
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


CALIBRATION = Calibration(480, 360, 394.0, 394.0, 239.5, 179.5, distortion=())
"""Of all: 63° across."""
LENSES = {
    "barrel": replace(CALIBRATION, distortion=(-0.08,)),
    "mild": replace(CALIBRATION, distortion=(-0.04,)),
    "pincushion": replace(CALIBRATION, distortion=(0.08,)),
    "fisheye": Calibration(
        512, 512, 163.0, 163.0, 255.5, 255.5, (0.0035, 0.0007, -0.002, 0.0002), model="fisheye"
    ),
}
"""Of other lenses: phones', and a fisheye that sees 180° across and 250° from corner to corner."""
MODIFIERS = ("blur", "exposure", "rolling", *LENSES, "guess", "untold")
"""What may follow the kind of a video, each after a +: of a `guess` the lens is not given, and
of an `untold` one the readout of a rolling shutter."""
READOUT = 0.02
"""Seconds from the first row to the last of a rolling shutter."""
_BAND = 6
"""Rows that are seen from one pose then."""
SHUTTER = 0.5
"""The share of the time between frames over which a blurred one is exposed."""
_FLOOR = 1.4
"""Metres from the camera down to the floor."""
_EXPOSURES = 4

Poses = Float[np.ndarray, "n 4 4"]


class Kind(NamedTuple):
    """A kind of video."""

    frames: int
    rate: float
    """Frames a second."""
    scene: Callable[[np.random.Generator], list[Body]]
    poses: Callable[[np.ndarray, np.random.Generator], Poses]
    """T_wc at times in seconds."""
    words: str


def rendered_source(
    name: str, seed: int, frames: int | None = None, folder: Path | None = None
) -> Source:
    """A video of a kind, as `orbit` or `turn+blur+exposure`, the same for the same seed.

    Its pictures are kept in and read from a folder of their own in `folder`, if given. Raises
    ValueError for a name that is not of `KINDS` and `MODIFIERS`.
    """
    word, *modifiers = name.split("+")
    if word not in KINDS or set(modifiers) - set(MODIFIERS):
        raise ValueError(f"{name}: {', '.join(KINDS)} with +{', +'.join(MODIFIERS)} are accepted")
    kind = KINDS[word]
    times = np.arange(frames or kind.frames) / kind.rate

    def images() -> Iterator[Image]:
        bodies = kind.scene(np.random.default_rng([seed, 0]))
        for index in range(len(times)):
            path = folder and folder / f"{name}-{seed}" / f"{index:05d}.png"
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path and path.exists() else None
            if image is None:
                image = _picture(kind, bodies, modifiers, seed, index)
                if path:
                    path.parent.mkdir(parents=True, exist_ok=True)
                    with write_atomically(path) as temporary:
                        cv2.imwrite(str(temporary), image)
            yield image

    truth = Trajectory(times, kind.poses(times, np.random.default_rng([seed, 1])))
    lens = _lens(modifiers)
    if "guess" in modifiers:
        lens = from_field_of_view(lens.width, lens.height)
    return Source(f"{name} (seed {seed})", lens, times, images, truth)


def _lens(modifiers: list[str]) -> Calibration:
    return next((LENSES[word] for word in modifiers if word in LENSES), CALIBRATION)


def _picture(kind: Kind, bodies: list[Body], modifiers: list[str], seed: int, index: int) -> Image:
    """The picture of a frame, which is exposed about its time, with the noise of a sensor."""
    time, outside = index / kind.rate, (_on_white, _street, _block, _row)
    sky = 245.0 if kind.scene in outside else 110.0
    offsets = np.zeros(1)
    if "blur" in modifiers:
        offsets = SHUTTER / kind.rate * ((np.arange(_EXPOSURES) + 0.5) / _EXPOSURES - 0.5)
    lens, rolling = _lens(modifiers), "rolling" in modifiers
    readout, rows = (READOUT, _BAND) if rolling else (0.0, lens.height)

    def band(top: int) -> Float[np.ndarray, "h w"]:
        """Rows that are seen at once."""
        late = readout * (top + (rows - 1) / 2 - lens.cy) / lens.height
        poses = kind.poses(time + late + offsets, np.random.default_rng([seed, 1]))
        part = replace(lens, height=rows, cy=lens.cy - top)
        return np.mean([render(bodies, T_wc, part, sky) for T_wc in poses], axis=0)

    grey = np.vstack([band(top) for top in range(0, lens.height, rows)])[: lens.height]
    if "exposure" in modifiers:
        grey = (0.8 + 0.25 * np.cos(2 * np.pi * time / 5.3)) * grey + 12 * np.sin(time)
    return add_noise(as_image(grey), np.random.default_rng([seed, 2, index]))


def _paint(rng: np.random.Generator, density: float, contrast: float = 90.0) -> Paint:
    """A paint of at most this contrast, drawn."""
    material, base = int(rng.integers(len(MATERIALS))), rng.uniform(70, 190)
    contrast *= rng.uniform(0.5, 1)
    return Paint(material, base, contrast, density, (rng.uniform(0, 512), rng.uniform(0, 512)))


def _things(rng: np.random.Generator, places: np.ndarray, density: float) -> list[Body]:
    """Boxes, spheres and thin bars, one at each place x, z, on the floor or hanging."""
    bodies = []
    for number, (x, z) in enumerate(places):
        yaw, paint = rng.uniform(0, np.pi), _paint(rng, density)
        if number % 4 == 3:  # from the floor to above the picture, or across it
            bodies.append(Body((x, 0.0, z), (0.025, _FLOOR, 0.025), paint, yaw))
            bodies.append(Body((x, rng.uniform(-1, 1), z), (0.6, 0.02, 0.02), paint, yaw))
        elif number % 4 == 2:
            radius = rng.uniform(0.15, 0.4)
            centre = (x, rng.uniform(-0.8, _FLOOR - radius), z)
            bodies.append(Body(centre, (radius,) * 3, paint, sphere=True))
        else:
            half = rng.uniform(0.12, 0.45, 3)
            y = _FLOOR - half[1] if number % 2 else rng.uniform(-1, 0.5)
            bodies.append(Body((x, y, z), half, paint, yaw))
    return bodies


def _room(rng: np.random.Generator) -> list[Body]:
    """A room of 10 x 12 m with things all round, none within 1.8 m of its middle's walk."""
    paper = _paint(rng, 55.0, 60.0)._replace(material=int(rng.integers(3)))  # nothing that repeats
    walls = Body((0, _FLOOR - 1.6, 0), (5, 1.6, 6), paper)
    angle = np.linspace(0, 2 * np.pi, 36, endpoint=False) + rng.uniform(-0.08, 0.08, 36)
    away = rng.uniform(2.4, 4.3, 36)
    places = np.stack([away * np.sin(angle), 1.2 * away * np.cos(angle)], 1)
    return [walls, *_things(rng, places, 150.0)]


def _on_white(rng: np.random.Generator) -> list[Body]:
    """An object of a few boxes, bars and spheres about the origin, on nothing."""
    bodies = [Body((0, 0.75, 0), (1.0, 0.08, 0.7), _paint(rng, 120.0))]
    for number in range(10):
        x, z = rng.uniform(-0.75, 0.75), rng.uniform(-0.5, 0.5)
        half, sphere = rng.uniform(0.08, 0.3, 3), number % 4 == 3
        half = np.full(3, half.min()) if sphere else half
        bar = np.array([0.02, 0.5, 0.02]) if number % 5 == 4 else half
        centre = (x, 0.67 - bar[1] - (0.4 if number % 3 == 1 else 0), z)
        yaw = rng.uniform(0, np.pi)
        bodies.append(Body(centre, bar, _paint(rng, 160.0), yaw, sphere))
    return bodies


_BEND = 15.0
"""Radius in metres of the street's curve, which begins `_STRAIGHT` metres from the start."""
_STRAIGHT = 60.0


def _along(way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places x, z on the street's middle after metres of way, and the heading there, rad."""
    heading = np.clip((way - _STRAIGHT) / _BEND, 0, np.pi / 2)
    after = np.maximum(way - _STRAIGHT - _BEND * np.pi / 2, 0)
    x = _BEND * (1 - np.cos(heading)) + after
    z = np.minimum(way, _STRAIGHT) + _BEND * np.sin(heading)
    return np.stack([x, z], 1), heading


def _street(rng: np.random.Generator) -> list[Body]:
    """Houses, cars and lamps at both sides of a road with a bend to the right."""
    ground = Body((30, _FLOOR + 1, 40), (140, 1, 140), Paint(2, 110.0, 35.0, 22.0))
    bodies = [ground]
    for way in np.arange(4.0, 260.0, 9.0):
        (middle,), (heading,) = _along(np.array([way]))
        aside = np.array([np.cos(heading), -np.sin(heading)])
        for side in (-1, 1):
            inner = side > 0 and abs(way - _STRAIGHT - _BEND * np.pi / 4) < _BEND
            if inner:  # the corner of the block
                continue
            height = rng.uniform(2.5, 5)
            x, z = middle + side * aside * rng.uniform(9, 11)
            half = (rng.uniform(2, 3), height, rng.uniform(3, 4.2))
            house = _paint(rng, 35.0, 80.0)
            bodies.append(Body((x, _FLOOR - height, z), half, house, heading))
            x, z = middle + side * aside * rng.uniform(4.2, 5)
            if rng.random() < 0.5:  # a lamp
                bodies.append(Body((x, -1.6, z), (0.07, 3, 0.07), _paint(rng, 60.0)))
            else:
                car = (0.8, 0.7, rng.uniform(1.2, 2))
                bodies.append(Body((x, _FLOOR - 0.7, z), car, _paint(rng, 60.0), heading))
    return bodies


_SIDE, _CORNER = 9.0, 3.0
"""Of a block: metres of a straight side, and the radius of the way round its corners."""


def _round(way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places x, z on the way round a block after metres of way, and the heading there, rad."""
    arc = _CORNER * np.pi / 2
    sides, rest = np.divmod(way, _SIDE + arc)
    turned = np.maximum(rest - _SIDE, 0) / _CORNER
    ahead = np.minimum(rest, _SIDE) + _CORNER * np.sin(turned)
    aside = _CORNER * (1 - np.cos(turned))
    side, heading = (
        np.stack([aside - _SIDE / 2 - _CORNER, ahead - _SIDE / 2], -1),
        sides * np.pi / 2,
    )
    c, s = np.cos(heading), np.sin(heading)
    turn = np.stack([np.stack([c, s], -1), np.stack([-s, c], -1)], -2)
    return (turn @ side[..., None])[..., 0], heading + turned


def _block(rng: np.random.Generator) -> list[Body]:
    """A block of houses and those on the other side of the street round it, with things between."""
    bodies = [Body((0, _FLOOR + 1, 0), (60, 1, 60), Paint(2, 110.0, 35.0, 22.0))]
    round_way = 4 * (_SIDE + _CORNER * np.pi / 2)
    for way in np.arange(0.0, round_way, 3.2):
        (middle,), (heading,) = _round(np.array([way]))
        aside = np.array([np.cos(heading), -np.sin(heading)])
        for side, away in ((1, 3.6), (-1, 5.5)):
            if side > 0 and np.abs(middle).max() - np.abs(middle).min() < _CORNER + 2:
                continue  # the corner of the block
            height = rng.uniform(2, 4)
            x, z = middle + side * aside * (away + rng.uniform(0, 0.8))
            half = (rng.uniform(0.8, 1.1), height, rng.uniform(1.1, 1.5))
            bodies.append(Body((x, _FLOOR - height, z), half, _paint(rng, 60.0, 80.0), heading))
            x, z = middle + side * aside * rng.uniform(1.7, 2.2)
            thing = rng.uniform(0.15, 0.45, 3)
            bodies.append(Body((x, _FLOOR - thing[1], z), thing, _paint(rng, 120.0), heading))
    return bodies


_BETWEEN = 2.5
"""Metres between two houses of a row."""


def _row(rng: np.random.Generator) -> list[Body]:
    """Houses in a row, each the same to the last thing before it."""
    bodies = [Body((20, _FLOOR + 1, 0), (60, 1, 30), Paint(2, 110.0, 35.0, 22.0))]
    wall, front = _paint(rng, 60.0, 80.0), [_paint(rng, 120.0) for _ in range(5)]
    sizes, x = rng.uniform(0.12, 0.4, (5, 3)), rng.uniform(-1.1, 1.1, 5)
    z = rng.uniform(2.0, 3.2, 5)
    for start in np.arange(-10 * _BETWEEN, 31 * _BETWEEN, _BETWEEN):
        bodies.append(Body((start, -1.0, 4.5), (_BETWEEN / 2 - 0.1, 2.4, 0.8), wall))
        for half, aside, away, paint in zip(sizes, x, z, front, strict=True):
            bodies.append(Body((start + aside, _FLOOR - half[1], away), half, paint))
    return bodies


def _posed(position: np.ndarray, yaw, pitch=0.0, roll=0.0) -> Poses:
    """Poses at positions (n, 3) of cameras that look to the right by yaw, up by pitch, in rad."""
    angles = np.stack(np.broadcast_arrays(yaw, pitch, roll), -1)
    T_wc = np.tile(np.eye(4), (len(position), 1, 1))
    T_wc[:, :3, :3] = Rotation.from_euler("YXZ", angles).as_matrix()
    T_wc[:, :3, 3] = position
    return T_wc


def _sway(times: np.ndarray, rng: np.random.Generator, *amplitudes: float) -> np.ndarray:
    """A hand: for each amplitude a slow and a small fast sinusoid, (amplitudes, n)."""
    periods = rng.uniform(2.5, 5, len(amplitudes)), rng.uniform(0.8, 1.6, len(amplitudes))
    phases = rng.uniform(0, 2 * np.pi, (2, len(amplitudes)))
    slow, fast = (
        np.sin(2 * np.pi * times / period[:, None] + phase[:, None])
        for period, phase in zip(periods, phases, strict=True)
    )
    return np.array(amplitudes)[:, None] * (slow + 0.08 * fast)


def _swaying(times: np.ndarray, rng: np.random.Generator) -> Poses:
    x, y, z, yaw, pitch, roll = _sway(times, rng, 0.6, 0.12, 0.3, 0.2, 0.07, 0.04)
    return _posed(np.stack([x, y, z], 1), yaw, pitch, roll)


def _orbiting(times: np.ndarray, rng: np.random.Generator) -> Poses:
    """18°/s round the origin, 3.2 m away and 25° above it."""
    angle, above = rng.uniform(0, 2 * np.pi) + 2 * np.pi * times / 20, np.radians(25)
    flat = 3.2 * np.cos(above)
    up = np.full_like(angle, -3.2 * np.sin(above))
    return _posed(np.stack([-flat * np.sin(angle), up, -flat * np.cos(angle)], 1), angle, -above)


def _turning(times: np.ndarray, rng: np.random.Generator) -> Poses:
    """Walks sideways and forward at about 0.7 m/s, and turns by 90° at up to 60°/s."""
    x, y, pitch, roll = _sway(times, rng, 0.05, 0.03, 0.02, 0.02)
    yaw = np.pi / 4 * (1 + np.tanh((times - 2.5) / 0.75))
    start = np.array([-1.2, 0, -1.2])
    walk = start + times[:, None] * [0.45, 0, 0.5] + np.stack([x, y, 0 * x], 1)
    return _posed(walk, yaw, pitch, roll)


def _spinning(times: np.ndarray, rng: np.random.Generator) -> Poses:
    yaw = rng.uniform(0, 2 * np.pi) + np.radians(30) * times
    return _posed(np.zeros((len(times), 3)), yaw)


def _looking(times: np.ndarray, rng: np.random.Generator) -> Poses:
    """Walks at 0.1 m/s while the gaze goes 75° to the right, back, and 75° to the left."""
    x, y, pitch, roll = _sway(times, rng, 0.1, 0.04, 0.05, 0.03)
    walk = np.stack([x, y, 0.1 * times - 1.2], 1)
    return _posed(walk, np.radians(75) * np.sin(2 * np.pi * times / 12), pitch, roll)


def _looking_round(times: np.ndarray, rng: np.random.Generator) -> Poses:
    """A hand on the spot that looks 75° to both sides, at up to 90°/s; it moves by a centimetre."""
    x, y, z, pitch, roll = _sway(times, rng, 0.01, 0.01, 0.01, 0.06, 0.03)
    return _posed(np.stack([x, y, z], 1), np.radians(75) * np.sin(1.2 * times), pitch, roll)


def _driving(times: np.ndarray, rng: np.random.Generator) -> Poses:
    """10 m/s, with the small pitching of a car."""
    y, pitch, roll = _sway(times, rng, 0.01, 0.004, 0.003)
    place, heading = _along(10 * times)
    return _posed(np.stack([place[:, 0], y, place[:, 1]], 1), heading, pitch, roll)


def _walking(times: np.ndarray, rng: np.random.Generator) -> Poses:
    """1.5 m/s round a block, looking ahead."""
    x, y, pitch, roll = _sway(times, rng, 0.03, 0.02, 0.02, 0.01)
    place, heading = _round(1.5 * times + 2.0)
    aside = np.stack([np.cos(heading), -np.sin(heading)], -1) * x[..., None]
    place = place + aside
    return _posed(np.stack([place[:, 0], y, place[:, 1]], 1), heading, pitch, roll)


def _passing(times: np.ndarray, rng: np.random.Generator) -> Poses:
    """1.2 m/s along a row of houses, looking at them and a little ahead."""
    x, y, yaw, pitch, roll = _sway(times, rng, 0.03, 0.02, 0.05, 0.02, 0.01)
    return _posed(np.stack([1.2 * times + x, y, 0 * x], 1), np.radians(25) + yaw, pitch, roll)


KINDS = {
    "boxes": Kind(150, 30, _room, _swaying, "a hand-held camera sways in a furnished room"),
    "orbit": Kind(200, 10, _on_white, _orbiting, "once round an object on a white background"),
    "orbit-twice": Kind(400, 10, _on_white, _orbiting, "twice round such an object"),
    "turn": Kind(150, 30, _room, _turning, "a walk with a turn of 60°/s"),
    "spin": Kind(600, 10, _room, _spinning, "a minute of pure rotation at 30°/s"),
    "look-round": Kind(180, 30, _room, _looking_round, "a hand on the spot that turns by 90°/s"),
    "look-around": Kind(500, 20, _room, _looking, "a slow walk with looks to both sides, ±75°"),
    "block": Kind(480, 10, _block, _walking, "a walk round a block, one and a third times"),
    "row": Kind(400, 10, _row, _passing, "a walk past houses that are all alike, 48 m"),
    "street": Kind(140, 10, _street, _driving, "a car at 10 m/s with a bend of 90°"),
}
