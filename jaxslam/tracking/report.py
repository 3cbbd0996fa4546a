"""The report of a tracker on each frame, and its file."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxslam._runtime.files import write_atomically
from jaxslam.io.source import Frame
from jaxslam.tracking.estimator import Correction
from jaxslam.tracking.map import Map
from jaxslam.tracking.observations import NOTHING, Lost, Observations
from jaxslam.tracking.pose_with_covariance import PoseWithCovariance

_COLUMNS = (
    "frame", "time", "state", "map", "matches", "nis", "nis_dof",
    "sigma_position", "sigma_orientation", "sigma_log_scale", "log_scale", "unit_fixed", "reason",
    "relocalised", "submap", "loop",
)  # fmt: skip


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
        off = (seen.pixels - seen.predicted)[found]
        weighted = np.linalg.solve(seen.covariances[found], off[..., None])[..., 0]
        return np.einsum("ki,ki->k", off, weighted)

    @property
    def state(self) -> str:
        """`start` of a map, `lost` or `tracked`."""
        return "start" if self.starts else "lost" if self.lost else "tracked"


def write_frames(path: str | Path, history: list[Tracked]) -> None:
    """Write what became of every frame as CSV, whole or not at all.

    `state` is `start` of a map (lost too, unless it is the first), `tracked` or `lost`. `map` is
    the number of the map, from 0. σ of position (map units) and orientation (rad) are roots of the
    summed variances of the three axes. They are zero in the first frame, which defines the world.
    `log_scale` is the log of that unit in metres as the filter estimates it at this frame, and
    `sigma_log_scale` its σ. Both are empty where the filter takes the unit for known. `unit_fixed`
    is 0 during the start of a map, when the filter changes its unit with every frame, else 1.
    `reason` is why the camera is lost (`Lost`), empty where it is not; `relocalised` is 1 where a
    camera that was lost is known to be back in a map that it had seen, whose number it then is.
    `submap` is the number of the submap, from 0 through all maps, and `loop` that of an earlier one
    of the map that is known again at this frame.
    """
    with write_atomically(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(_COLUMNS)
        writer.writerows(_row(result) for result in history)


def _row(result: Tracked) -> list[object]:
    camera = result.camera
    numbers = (
        camera.sigma_position, camera.sigma_orientation, result.sigma_log_scale, result.log_scale,
    )  # fmt: skip
    return [
        result.index,
        f"{result.time:.9f}",
        result.state,
        result.map,
        result.status.count("matched"),
        f"{result.nis:.6g}",
        result.nis_dof,
        *("" if number is None else f"{number:.6g}" for number in numbers),
        int(result.unit_fixed),
        result.reason or "",
        int(result.relocalised),
        result.submap,
        "" if result.loop is None else result.loop,
    ]
