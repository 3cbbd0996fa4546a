"""Recorded bearings with identities: feature tracks on drives through streets, with true poses.

A folder of KITTI's tracks, as `kitti_tracks` has them: `tracks.npz` (observations by frame and
track, which tracks move, times, intrinsics) and `groundtruth.txt` in TUM's format, T_WC.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam._runtime.files import read_arrays
from jaxslam.io.tum import read_tum
from jaxslam.models.camera import Camera
from jaxslam.models.sensors import Pinhole
from jaxslam.simulation import Run

MOVING = 1
"""What a track is marked with that contradicts a still scene."""
GOLDEN = (5**0.5 - 1) / 2
"""Of one: each multiple falls into the widest gap that those before it leave, modulo 1."""
_SHAPES = {
    "frame": ("observations",), "track": ("observations",), "pixel": ("observations", 2),
    "moving": ("tracks",), "times": ("frames",), "intrinsics": (4,), "image_size": (2,),
}  # fmt: skip


@dataclass(frozen=True)
class Tracks:
    """A drive, as its camera sees it. SI units, pixels."""

    frame: Int[np.ndarray, " observations"]
    track: Int[np.ndarray, " observations"]
    """Numbered by first sight."""
    pixel: Float[np.ndarray, "observations 2"]
    moving: Int[np.ndarray, " tracks"]
    """1: moves, or is a wrong match; 0: stands still; −1: nobody knows."""
    times: Float[np.ndarray, " frames"]
    poses: Float[np.ndarray, "frames 4 4"]
    """T_WC, true."""
    camera: Camera
    image: Int[np.ndarray, " 2"]
    """Width and height of a picture."""

    @property
    def frames(self) -> int:
        return self.times.size


def read(folder: str | Path) -> Tracks:
    """Read a drive. Raises ValueError, naming the file, unless it is one."""
    path = Path(folder) / "tracks.npz"
    arrays = read_arrays(path, _SHAPES)
    _check(path, arrays)
    _, poses = read_tum(Path(folder) / "groundtruth.txt")
    if len(poses) != arrays["times"].size:
        raise ValueError(
            f"{folder} has {len(poses)} true poses of {arrays['times'].size} frames; one of each "
            "is needed"
        )
    fx, fy, cx, cy = arrays["intrinsics"]
    return Tracks(
        frame=arrays["frame"],
        track=arrays["track"],
        pixel=np.asarray(arrays["pixel"], float),
        moving=arrays["moving"],
        times=np.asarray(arrays["times"], float),
        poses=poses,
        camera=Camera([fx, fy], [cx, cy]),
        image=arrays["image_size"],
    )


def _check(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Raise ValueError, naming the file, for arrays that are none of a drive."""
    if missing := [name for name in _SHAPES if name not in arrays]:
        raise ValueError(f"{path} lacks {', '.join(missing)}: it holds no tracks")
    sizes: dict[str, int] = {}
    for name, shape in _SHAPES.items():
        x = arrays[name]
        wanted = tuple(sizes.setdefault(n, x.size) if isinstance(n, str) else n for n in shape)
        if x.shape != wanted or not np.isfinite(x).all():
            raise ValueError(f"{path}: {name} must be numbers of the shape {wanted}, not {x.shape}")
    for name in ("frame", "track"):
        if ((arrays[name] < 0) | (arrays[name] >= sizes[f"{name}s"])).any():
            raise ValueError(f"{path}: {name} holds a number that is not from 0 to {name}s - 1")


def window(
    data: Tracks, start: int, steps: int, *, landmarks: int = 40, moving: bool = False
) -> Run:
    """Frames `start` to `start + steps` as a run whose base B is the camera of its first frame.

    It has at most so many tracks at a time, spread over the picture; where one ends, another takes
    its slot. Tracks known to be `moving` are left out unless they are asked for. What is not known,
    where points are and the σ of a pixel, is NaN. Raises ValueError for a window that is not in
    the drive.
    """
    if steps < 1 or start < 0 or start + steps >= data.frames or landmarks < 1:
        raise ValueError(
            f"{steps} steps from frame {start} with {landmarks} landmarks are not in "
            f"{data.frames} frames; at least one step and one landmark is accepted"
        )
    frames = slice(start, start + steps + 1)
    measured, visible, new = _in_slots(_observations(data, frames, moving), landmarks)
    T_BC = np.linalg.inv(data.poses[start]) @ data.poses[frames]

    def every(x):
        return jnp.broadcast_to(x, (steps + 1, *np.shape(x)))

    return Run(
        poses=jaxlie.SE3.from_matrix(jnp.asarray(T_BC)),
        points=jnp.full((*visible.shape, 3), jnp.nan),
        measured=jnp.asarray(measured),
        visible=jnp.asarray(visible),
        controls=jnp.asarray(np.diff(data.times[frames])),
        sensors=jax.tree.map(every, Pinhole(data.camera, np.nan)),
        new=jnp.asarray(new),
    )


def windows(data: Tracks, steps: int, count: int, *, landmarks: int = 40) -> Run:
    """A batch of windows, evenly over the drive; they overlap where they do not fit otherwise."""
    starts = np.linspace(0, data.frames - steps - 1, count).astype(int)
    runs = [window(data, int(start), steps, landmarks=landmarks) for start in starts]
    return jax.tree.map(lambda *parts: jnp.stack(parts), *runs)


def _observations(data: Tracks, frames: slice, moving: bool) -> Iterator[dict[int, np.ndarray]]:
    """Of every frame, the pixel of each track, in an order whose beginnings are spread.

    Tracks are numbered across the picture: the first so many are all on one side of it.
    """
    turn = GOLDEN * data.track % 1
    wanted = moving | (data.moving[data.track] != MOVING)
    for k in range(frames.start, frames.stop):
        here = np.flatnonzero(wanted & (data.frame == k))
        here = here[np.argsort(turn[here])]
        yield {int(data.track[i]): data.pixel[i] for i in here}


def _in_slots(
    observations: Iterator[dict[int, np.ndarray]], count: int
) -> tuple[
    Float[np.ndarray, "frames slots 2"], Bool[np.ndarray, "frames slots"], Bool[np.ndarray, ...]
]:
    """Pixels, which slots are seen, and in which of them another track begins."""
    held: list[int | None] = [None] * count
    rows = []
    for pixels in observations:
        kept = [track if track in pixels else None for track in held]
        waiting = (track for track in pixels if track not in kept)
        held = [next(waiting, None) if track is None else track for track in kept]
        rows.append(
            (
                [pixels.get(track, np.zeros(2)) for track in held],
                [track is not None for track in held],
                [now is not None and now != before for now, before in zip(held, kept, strict=True)],
            )
        )
    measured, visible, new = (np.array(column) for column in zip(*rows, strict=True))
    return measured, visible, new
