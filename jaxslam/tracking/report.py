"""The report of a tracker on each frame, and its file."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxslam._runtime.files import append_whole, write_text
from jaxslam.io.source import Frame
from jaxslam.io.tum import tum_text
from jaxslam.tracking.estimator import Correction
from jaxslam.tracking.map import Map
from jaxslam.tracking.observations import NOTHING, Lost, Observations, distances
from jaxslam.tracking.pose_with_covariance import PoseWithCovariance


@dataclass(frozen=True)
class Tracked:
    """The result of one frame; k landmarks were searched, j created."""

    index: int
    """The number of the frame in its video."""
    time: float
    """The time of the frame, s."""
    camera: PoseWithCovariance
    """The camera in the world, which is the first camera; of a later map, by way of its start. All
    of a map in one unit (docs/gauge.md), and the covariance is of the pose in that unit."""
    observations: Observations = NOTHING
    """The observations of the landmarks searched."""
    created: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    """Pixels of new landmarks, (j, 2)."""
    nis: float = 0.0
    """The normalised innovation squared of all matches."""
    nis_dof: int = 0
    """The degrees of freedom of NIS: two for each match."""
    reason: Lost | None = None
    """Why the camera is lost, if it is."""
    starts: bool = False
    """Whether a map begins here; where it is not the first, the camera was lost too."""
    relocalised: bool = False
    """Whether the camera, which was lost, is known to be back in a map that it had seen before."""
    loop: int | None = None
    """Number of the submap whose landmarks the frame shows again, where that closes a loop."""
    repeated: bool = False
    """Whether the picture is the one before once more: it says nothing new, and is not used."""
    submap: int = 0
    """Number of the submap, among those of all maps."""
    map: int = 0
    """Number of the map; each has a unit of length of its own."""
    log_scale: float | None = None
    """Log of the map's unit in metres as the filter now believes it to be, where it has a unit of
    its own: e^log_scale times this pose is what it takes for metres."""
    sigma_log_scale: float | None = None
    """σ of that, where the filter is in doubt of it."""
    sights: Mapping[int, np.ndarray] = field(default_factory=dict)
    """Pixels of the landmarks that were matched or created, by their numbers."""
    unit_fixed: bool = True
    """Whether the filter keeps its unit from here on. While a start is being found out it does not,
    and the map's is carried over by the landmarks' distances, about which no covariance knows."""

    @classmethod
    def of(
        cls,
        frame: Frame,
        map: Map,
        observations: Observations = NOTHING,
        correction: Correction | None = None,
        **found,
    ) -> Tracked:
        """Return what became of a frame, after which the map is this one; `found` are other
        fields."""
        place, doubt = map.place, map.place.sigma_log_scale
        if correction is not None:
            found |= {"nis": float(correction.nis), "nis_dof": int(correction.nis_dof)}
        return cls(
            frame.index,
            frame.time,
            place.camera,
            observations,
            map=map.number,
            submap=map.submap,
            log_scale=None if doubt is None else place.log_scale,
            sigma_log_scale=doubt,
            sights={one.number: one.seen_at for one in map.landmarks.values() if not one.unseen},
            unit_fixed=place.unit_fixed,
            **found,
        )

    @property
    def lost(self) -> bool:
        """Whether nothing in the frame tells where the camera is."""
        return self.reason is not None

    @property
    def T_wc(self) -> np.ndarray:
        """The camera's pose, (4, 4)."""
        return self.camera.T_wc

    @property
    def covariance(self) -> np.ndarray:
        """The covariance (6, 6) in the right tangent of T_wc: position in camera axes, rotation."""
        return self.camera.covariance

    @property
    def status(self) -> list[str]:
        """`matched`, `unmatched` or `outlier`, k of them."""
        return self.observations.labels.tolist()

    @property
    def innovations(self) -> Float[np.ndarray, " f"]:
        """Squared innovations `νᵀ S⁻¹ ν` of the f landmarks that were found, before any was tested
        for agreement: of two degrees of freedom each where the prediction is right."""
        seen = self.observations
        found = np.isfinite(seen.pixels[:, 0])
        return distances((seen.pixels - seen.predicted)[found], seen.covariances[found])

    @property
    def state(self) -> str:
        """`start` of a map, `lost` or `tracked`."""
        return "start" if self.starts else "lost" if self.lost else "tracked"


History = Sequence[Tracked]
"""What became of the frames so far."""


def trajectory_text(history: History) -> str:
    """The poses of all frames in TUM format. All of a map are in one unit of length
    (docs/gauge.md), and the header says so."""
    poses = np.stack([result.T_wc for result in history])
    times = [result.time for result in history]
    return tum_text(times, poses, "in the unit of each map (frames.csv)")


def frames_text(history: History) -> str:
    """What became of every frame, as CSV.

    `state` is `start` of a map (lost too, unless it is the first), `tracked` or `lost`. `map` is
    the number of the map, from 0. σ of position (map units) and orientation (rad) are roots of the
    summed variances of the three axes. They are zero in the first frame, which defines the world.
    `log_scale` is the log of that unit in metres as the filter estimates it at this frame, and
    `sigma_log_scale` its σ. Both are empty where the filter takes the unit for known. `unit_fixed`
    is 0 during the start of a map, when the filter changes its unit with every frame, else 1.
    `reason` is why the camera is lost (`Lost`), empty where it is not; `relocalised` is 1 where a
    camera that was lost is known to be back in a map that it had seen, whose number it then is.
    `submap` is the number of the submap, from 0 through all maps, and `loop` that of an earlier one
    of the map that is known again at this frame. `repeated` is 1 where the picture is the one
    before once more: its pose is that of this picture, and nothing was learnt from it.
    """
    file = io.StringIO()
    rows = [_row(result) for result in history]
    writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return file.getvalue()


TEXTS = {"trajectory.txt": trajectory_text, "frames.csv": frames_text}
"""Files that grow with every frame."""


def add_latest(out: Path, history: History) -> None:
    """Add the latest frame to the files in a folder, which are whole at any time; an interruption
    of the first two leaves none."""
    for name, text in TEXTS.items():
        if len(history) > 2:
            append_whole(out / name, text(history[-1:]).splitlines(keepends=True)[-1])
        elif len(history) == 2:
            write_text(out / name, text(history))


def _row(result: Tracked) -> dict[str, object]:
    camera = result.camera

    def short(number: float | None) -> str:
        return "" if number is None else f"{number:.6g}"

    return {
        "frame": result.index,
        "time": f"{result.time:.9f}",
        "state": result.state,
        "map": result.map,
        "matches": result.status.count("matched"),
        "nis": short(result.nis),
        "nis_dof": result.nis_dof,
        "sigma_position": short(camera.sigma_position),
        "sigma_orientation": short(camera.sigma_orientation),
        "sigma_log_scale": short(result.sigma_log_scale),
        "log_scale": short(result.log_scale),
        "unit_fixed": int(result.unit_fixed),
        "reason": result.reason or "",
        "relocalised": int(result.relocalised),
        "submap": result.submap,
        "loop": "" if result.loop is None else result.loop,
        "repeated": int(result.repeated),
    }
