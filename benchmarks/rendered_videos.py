"""Rendered videos with what real ones have, and their exact truth: see `KINDS`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float
from ray_caster import MATERIALS, Body, Paint, as_image, render
from scipy.spatial.transform import Rotation

from jaxslam._runtime.files import write_atomically
from jaxslam.io.calibration import Calibration
from jaxslam.io.source import Image, Source, Trajectory
from jaxslam.tracking.synthetic import add_noise

CALIBRATION = Calibration(480, 360, 394.0, 394.0, 239.5, 179.5, distortion=())
"""Of all: 63° across."""
MODIFIERS = ("blur", "exposure")
"""What may follow the kind of a video, each after a +."""
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
                _keep(image, path)
            yield image

    truth = Trajectory(times, kind.poses(times, np.random.default_rng([seed, 1])))
    return Source(f"{name} (seed {seed})", CALIBRATION, times, images, truth)


def _picture(kind: Kind, bodies: list[Body], modifiers: list[str], seed: int, index: int) -> Image:
    """The picture of a frame, which is exposed about its time, with the noise of a sensor."""
    time, sky = (
        index / kind.rate,
        245.0 if kind.scene in (_on_white, _street, _block, _row) else 110.0,
    )
    offsets = np.zeros(1)
    if "blur" in modifiers:
        offsets = SHUTTER / kind.rate * ((np.arange(_EXPOSURES) + 0.5) / _EXPOSURES - 0.5)
    poses = kind.poses(time + offsets, np.random.default_rng([seed, 1]))
    grey = np.mean([render(bodies, T_wc, CALIBRATION, sky) for T_wc in poses], axis=0)
    if "exposure" in modifiers:
        grey = (0.8 + 0.25 * np.cos(2 * np.pi * time / 5.3)) * grey + 12 * np.sin(time)
    return add_noise(as_image(grey), np.random.default_rng([seed, 2, index]))


def _keep(image: Image, path: Path | None) -> None:
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        with write_atomically(path) as temporary:
            cv2.imwrite(str(temporary), image)


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


_APART = 2.5
"""Metres between two houses of a row."""


def _row(rng: np.random.Generator) -> list[Body]:
    """Houses in a row, each the same to the last thing before it."""
    bodies = [Body((20, _FLOOR + 1, 0), (60, 1, 30), Paint(2, 110.0, 35.0, 22.0))]
    wall, front = _paint(rng, 60.0, 80.0), [_paint(rng, 120.0) for _ in range(5)]
    sizes, x = rng.uniform(0.12, 0.4, (5, 3)), rng.uniform(-1.1, 1.1, 5)
    z = rng.uniform(2.0, 3.2, 5)
    for start in np.arange(-10 * _APART, 31 * _APART, _APART):
        bodies.append(Body((start, -1.0, 4.5), (_APART / 2 - 0.1, 2.4, 0.8), wall))
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
    "look-around": Kind(500, 20, _room, _looking, "a slow walk with looks to both sides, ±75°"),
    "block": Kind(480, 10, _block, _walking, "a walk round a block, one and a third times"),
    "row": Kind(400, 10, _row, _passing, "a walk past houses that are all alike, 48 m"),
    "street": Kind(140, 10, _street, _driving, "a car at 10 m/s with a bend of 90°"),
}
