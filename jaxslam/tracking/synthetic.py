"""A synthetic handheld video of a textured room, rendered with its exact trajectory.

The room is made of textured planar quads painted from the back to the front. Each is warped by
its exact homography onto a canvas of twice the size, which is then averaged down: that is the
anti-aliasing, and it puts the centre of pixel (u, v) at canvas position (2u + 0.5, 2v + 0.5).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxslam.io.calibration import Calibration
from jaxslam.io.source import Image, Source, Trajectory
from jaxslam.io.tum import transforms
from jaxslam.tracking.patches import Picture
from jaxslam.tracking.pose_with_covariance import Places, Positions, Transform, Transforms

NOISE = 2.0  # standard deviation of the sensor noise, in grey levels
SUPERSAMPLING = 2
FLOOR = 1.3  # the floor's y: metres below the first camera
WALL = 7.0  # the back wall's z: metres in front of the first camera
_NEAREST = 0.2  # metres: every corner of every quad stays at least so far before the camera


@dataclass(frozen=True)
class Quad:
    """A textured planar parallelogram: a corner and its two edges, in metres in the world frame.

    Texture pixel (i, j) of (h, w) has its centre at corner + (j + 1/2)/w right + (i + 1/2)/h down.
    Seen only from the side on which `right` x `down` points away.
    """

    corner: Float[np.ndarray, " 3"]
    right: Float[np.ndarray, " 3"]
    down: Float[np.ndarray, " 3"]
    texture: Picture

    def point(self, pixel: Places) -> Positions:
        """World points (n, 3) in metres of texture positions x, y (n, 2) in texture pixels."""
        h, w = self.texture.shape
        x, y = (np.asarray(pixel, dtype=float) + 0.5).T[..., None] / np.array([w, h])[:, None, None]
        return self.corner + x * self.right + y * self.down


def synthetic_source(
    frames: int = 150, seed: int = 0, width: int = 640, height: int = 480, rate: float = 30.0
) -> Source:
    """A rendered handheld video with its exact reference; the same for the same arguments.

    `frames` pictures of `width` x `height` pixels at `rate` 1/s; the world frame is the first
    camera's, in metres. Raises `ValueError` for sizes and rates that are not positive.
    """
    for name, value in [("frames", frames), ("width", width), ("height", height), ("rate", rate)]:
        if not value > 0:
            raise ValueError(f"{name} must be positive, not {value}")
    focal = 0.82 * max(width, height * 4 / 3)  # 63 degrees across, which the scene fills
    centre = (width - 1) / 2, (height - 1) / 2
    calibration = Calibration(width, height, focal, focal, *centre)
    times = np.arange(frames) / rate
    T_wc = handheld_trajectory(times, seed)

    def images() -> Iterator[Image]:
        quads = room(seed, focal)
        for index, pose in enumerate(T_wc):
            yield add_noise(render(quads, pose, calibration), np.random.default_rng([seed, index]))

    return Source(f"synthetic (seed {seed})", calibration, times, images, Trajectory(times, T_wc))


def handheld_trajectory(times: Float[np.ndarray, " n"], seed: int = 0) -> Transforms:
    """Poses T_wc (n, 4, 4) at times in seconds: swaying sideways, with all six degrees of freedom.

    Sums of two sinusoids for each of x, y, z (m) and the rotation vector (rad), shifted so that
    the pose at time 0 is the identity; the velocity there is not zero.
    """
    rng = np.random.default_rng([seed, 1])
    #                      x     y     z     pitch  yaw    roll
    amplitude = np.array([[0.55, 0.09, 0.22, 0.035, 0.07, 0.03],
                          [0.04, 0.02, 0.03, 0.008, 0.01, 0.01]])  # fmt: skip
    period = np.array([[5.2, 3.1, 6.3, 3.7, 4.6, 4.1], [1.7, 1.3, 1.9, 1.2, 1.6, 1.5]])
    phase = rng.uniform(-np.pi, np.pi, amplitude.shape)
    phase[0, 0] = rng.uniform(-0.5, 0.5)  # starts at full speed sideways
    angle = 2 * np.pi * np.asarray(times, dtype=float)[:, None, None] / period + phase
    motion = np.sum(amplitude * (np.sin(angle) - np.sin(phase)), axis=1)
    return transforms(Rotation.from_rotvec(motion[:, 3:]).as_matrix(), motion[:, :3])


def render(quads: Sequence[Quad], T_wc: Transform, calibration: Calibration) -> Image:
    """The noise-free picture of quads, painted in the order given, seen from the pose `T_wc`.

    Raises `ValueError` where a quad reaches behind the camera; distortion is not rendered.
    """
    n = SUPERSAMPLING
    size = (calibration.width, calibration.height)
    canvas = np.full((n * size[1], n * size[0]), 110, np.uint8)
    zoom = np.array([[n, 0, (n - 1) / 2], [0, n, (n - 1) / 2], [0, 0, 1]])
    for quad in quads:
        _paint(canvas, quad, T_wc, zoom @ calibration.matrix)
    return cv2.resize(canvas, size, interpolation=cv2.INTER_AREA)


def add_noise(image: Image, rng: np.random.Generator, sigma: float = NOISE) -> Image:
    """The image with Gaussian noise of `sigma` grey levels, rounded and clipped."""
    noise = rng.standard_normal(image.shape, dtype=np.float32)
    noise *= sigma
    return cv2.add(image, noise, dtype=cv2.CV_8U)


@cache
def room(seed: int, focal: float) -> tuple[Quad, ...]:
    """The room's quads from the back to the front, textured for a focal length in pixels."""
    rng = np.random.default_rng([seed, 0])
    # The wall reaches below the floor, and the floor's strips overlap, so that no seam shows.
    wall = _upright(rng, focal, (0.0, FLOOR / 2 - 2.4, WALL), (18.0, FLOOR + 5.0), contrast=45.0)
    quads = [wall]
    for x, y, w, h, base in [(-3.0, -1.3, 1.6, 1.2, 205.0), (1.3, -1.6, 2.2, 1.4, 60.0)]:
        quads.append(_upright(rng, focal, (x, y, WALL - 0.05), (w, h), base=base, frame=0.05))
    quads += _floor(rng, focal)
    for x, z, side, height, base in [(2.6, 5.4, 0.9, 1.9, 90.0), (-0.6, 4.7, 0.7, 0.8, 170.0)]:
        quads += _box(rng, focal, (x, z), (side, height), base)
    for x, y, z, w, h, yaw, base in [
        (-2.1, 0.35, 4.0, 1.1, 1.9, 0.5, 60.0),
        (1.0, -0.9, 3.6, 0.7, 0.5, -0.2, 200.0),
        (1.35, 0.75, 3.0, 0.9, 1.1, -0.5, 190.0),
        (-0.2, -0.75, 2.6, 0.5, 0.35, 0.3, 70.0),
        (-0.95, 0.45, 2.0, 0.5, 0.6, 0.35, 200.0),
        (0.55, 0.45, 1.6, 0.35, 0.3, -0.3, 60.0),
    ]:  # standing boards and hanging cards, the nearest last
        quads.append(_upright(rng, focal, (x, y, z), (w, h), yaw, base, frame=0.02))
    return tuple(quads)


def texture(
    rng: np.random.Generator,
    size: tuple[float, float],
    density: tuple[float, float],
    base: float = 130.0,
    contrast: float = 90.0,
) -> Picture:
    """Random rectangles, discs and triangles of many sizes over soft noise, uint8 (h, w).

    `size` in metres and `density` in texture pixels a metre, both across and down; grey levels
    keep within about `contrast` of `base`.
    """
    w, h = round(size[0] * density[0]), round(size[1] * density[1])
    soft = rng.uniform(-1, 1, (max(h // 60, 2), max(w // 60, 2))).astype(np.float32)
    soft = base + 0.2 * contrast * cv2.resize(soft, (w, h), interpolation=cv2.INTER_CUBIC)
    image = np.clip(soft, 0, 255).astype(np.uint8)
    # Shapes are round in metres, not in texture pixels; `radius` is in pixels across.
    squash = density[1] / density[0]
    for radius in np.geomspace(max(0.12 * min(w, h / squash), 16.0), 9.0, 5):
        for _ in range(min(int(0.04 * w * h / (squash * radius**2)), 500)):
            grey = base + contrast * rng.choice([-1, 1]) * rng.uniform(0.3, 1)
            _shape(image, rng, radius, squash, float(np.clip(grey, 5, 250)))
    return image


def _shape(
    image: Picture, rng: np.random.Generator, radius: float, squash: float, grey: float
) -> None:
    centre = rng.uniform((0, 0), image.shape[::-1])
    corners = int(rng.choice([3, 4, 4, 4, 24]))
    # Squares have their corners on the diagonals, so that stretching makes them rectangles.
    angles = np.pi / corners + np.arange(corners) * 2 * np.pi / corners
    points = radius * np.stack([np.cos(angles), np.sin(angles)], 1)
    points *= (rng.uniform(0.5, 1.5), 1.0) if corners == 4 else (1.0, 1.0)
    turn = rng.uniform(0, 2 * np.pi)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    points = centre + points @ rotation * (1.0, squash)
    sixteenths = np.rint(points * 16).astype(np.int32)
    cv2.fillConvexPoly(image, sixteenths, grey, lineType=cv2.LINE_AA, shift=4)


def _upright(
    rng: np.random.Generator,
    focal: float,
    centre: tuple[float, float, float],
    size: tuple[float, float],
    yaw: float = 0.0,
    base: float = 130.0,
    contrast: float = 80.0,
    frame: float = 0.0,
) -> Quad:
    """A vertical board facing the first camera, turned by `yaw` (rad) about the vertical.

    `base` and `contrast` are its texture's, `frame` (m) is the width of its dark frame.
    """
    right = size[0] * np.array([np.cos(yaw), 0.0, np.sin(yaw)])
    down = np.array([0.0, size[1], 0.0])
    density = SUPERSAMPLING * focal / centre[2]
    image = texture(rng, size, (density, density), base, contrast)
    if frame:
        border = round(frame * density)
        h, w = image.shape
        cv2.rectangle(image, (0, 0), (w - 1, h - 1), 20, thickness=2 * border)
    return Quad(np.array(centre) - right / 2 - down / 2, right, down, image)


def _box(
    rng: np.random.Generator,
    focal: float,
    place: tuple[float, float],
    size: tuple[float, float],
    base: float,
) -> list[Quad]:
    """A box on the floor, of square ground plan: the two sides, the top, then the front.

    `place` is x and z of the front's centre, `size` the side and the height, in metres.
    """
    (x, z), (side, height) = place, size
    density = SUPERSAMPLING * focal / z
    left, right, top = x - side / 2, x + side / 2, FLOOR - height
    across, depth, down = np.diag([side, side, height])[:, [0, 2, 1]]
    return [
        Quad(np.array(corner), edge, fall, texture(rng, extent, (density, density), grey, 60.0))
        for corner, edge, fall, extent, grey in [
            ((left, top, z + side), -depth, down, (side, height), 0.6 * base),
            ((right, top, z), depth, down, (side, height), 0.6 * base),
            ((left, top, z + side), across, -depth, (side, side), min(1.3 * base, 220.0)),
            ((left, top, z), across, down, (side, height), base),
        ]
    ]


def _floor(rng: np.random.Generator, focal: float) -> list[Quad]:
    """The floor in strips, each with the texture density that its distance needs."""
    strips = []
    for near, far in [(4.75, WALL), (3.35, 4.8), (2.35, 3.4), (1.4, 2.4)]:
        middle, half_width = (near + far) / 2, 1.4 + 0.8 * far
        across = SUPERSAMPLING * focal / middle
        # Foreshortened: one metre along z spans focal * FLOOR / z^2 pixels.
        density = (across, across * min(1.0, 1.5 * FLOOR / middle))
        size = (2 * half_width, far - near)
        corner = np.array([-half_width, FLOOR, far])
        right, down = np.array([size[0], 0.0, 0.0]), np.array([0.0, 0.0, -size[1]])
        strips.append(Quad(corner, right, down, texture(rng, size, density, 95.0, 35.0)))
    return strips


def _paint(canvas: Picture, quad: Quad, T_wc: Transform, camera: Float[np.ndarray, "3 3"]) -> None:
    """Warp a quad onto the part of the canvas that it covers; nothing if it shows its back."""
    R_cw = T_wc[:3, :3].T
    corner = R_cw @ (quad.corner - T_wc[:3, 3])
    right, down = R_cw @ quad.right, R_cw @ quad.down
    plane = np.stack([right, down, corner], axis=1)  # (x, y, 1) in the quad -> camera frame
    if np.linalg.det(plane) <= 0:
        return
    ends = plane @ np.array([[0, 1, 1, 0], [0, 0, 1, 1], [1, 1, 1, 1]])
    if ends[2].min() < _NEAREST:
        raise ValueError(f"a quad comes closer than {_NEAREST} m to the camera's plane")
    ends = camera @ ends
    box = ends[:2] / ends[2]
    low = np.maximum(np.floor(box.min(axis=1)), 0).astype(int)
    high = np.minimum(np.ceil(box.max(axis=1)) + 1, canvas.shape[::-1]).astype(int)
    if np.any(low >= high):
        return
    h, w = quad.texture.shape
    to_quad = np.array([[1 / w, 0, 0.5 / w], [0, 1 / h, 0.5 / h], [0, 0, 1]])
    shift = np.array([[1, 0, -low[0]], [0, 1, -low[1]], [0, 0, 1]])
    part = canvas[low[1] : high[1], low[0] : high[0]]
    cv2.warpPerspective(
        quad.texture, shift @ camera @ plane @ to_quad, (part.shape[1], part.shape[0]),
        dst=part, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_TRANSPARENT,
    )  # fmt: skip
