"""A recording of a tracked video for the rerun viewer, written as the frames come."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from uuid import uuid4

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from jaxslam._runtime.extras import missing
from jaxslam.io.calibration import Calibration
from jaxslam.io.source import Frame
from jaxslam.tracking.landmarks import Points
from jaxslam.tracking.overlay import COLOURS, search_ellipses
from jaxslam.tracking.report import Tracked

_IMAGE = "world/camera/image"
_TRACKED, _LOST = (0, 114, 178), (150, 150, 150)  # of the path


class Viewer:
    """A file for rerun (`rerun FILE.rrd`), of the frames so far at any end; nothing is sent.

    Its timelines are `frame` and `time` (s since the first frame). It shows the picture with search
    ellipses of three standard deviations and matches by status, the camera and its path (grey where
    it was lost), and ends of submaps with the loops to them. Landmarks have 1 σ ellipsoids. Curves
    are of NIS over its degrees of freedom, and of σ and `log_scale` of `frames.csv`. A change of
    state is logged. All of a map is in one unit.
    Raises `ValueError` without rerun, or for a name that does not end in .rrd.
    """

    def __init__(self, path: str | Path, calibration: Calibration) -> None:
        self.path = Path(path)
        self.calibration = calibration
        self._rerun = _rerun()
        if self.path.suffix.lower() != ".rrd":
            raise ValueError(f"{self.path}: the name must end in .rrd")
        self._began: float | None = None
        self._piece, self._positions = 0, np.zeros((0, 3))
        self._before: Tracked | None = None
        self._ends: dict[int, np.ndarray] = {}
        self._loops: list[list[np.ndarray]] = []

    def __enter__(self) -> Viewer:
        rr, c = self._rerun, self.calibration
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._record = rr.RecordingStream("jaxslam", recording_id=uuid4())
        self._record.save(self.path, default_blueprint=_layout())
        self._record.log("world", rr.ViewCoordinates.RDF, static=True)
        # Length of the camera's pyramid, map units
        camera = rr.Pinhole(
            image_from_camera=c.matrix, width=c.width, height=c.height,
            camera_xyz=rr.ViewCoordinates.RDF, image_plane_distance=0.3,
        )  # fmt: skip
        self._record.log(_IMAGE, camera, static=True)
        return self

    def show(self, frame: Frame, result: Tracked) -> None:
        """Record a frame."""
        began = self._began = result.time if self._began is None else self._began
        self._record.set_time("frame", sequence=result.index)
        self._record.set_time("time", duration=result.time - began)
        self._show_picture(frame, result)
        self._show_camera(result)
        self._show_graph(result)
        self._show_numbers(result)
        self._before = result

    def show_map(self, known: Points) -> None:
        """Record the landmarks, of the time of the last frame."""
        rr = self._rerun
        variances, axes = np.linalg.eigh(known.covariances)
        axes[np.linalg.det(axes) < 0, :, 0] *= -1
        quaternions = Rotation.from_matrix(axes).as_quat() if len(axes) else np.zeros((0, 4))
        sigmas = np.sqrt(np.maximum(variances, 0.0))
        colour = _rgb("matched")
        shapes = {"half_sizes": sigmas, "centers": known.points, "quaternions": quaternions}
        ellipsoids = rr.Ellipsoids3D(**shapes, colors=colour)
        labels = [f"{one}, map {of}" for one, of in zip(known.numbers, known.maps, strict=True)]
        points = rr.Points3D(known.points, colors=colour, labels=labels, show_labels=False)
        self._record.log("world/landmarks/sigma", ellipsoids)
        self._record.log("world/landmarks", points)

    def __exit__(self, *raised: object) -> None:
        self._record.disconnect()

    def _show_picture(self, frame: Frame, result: Tracked) -> None:
        rr = self._rerun
        jpeg = cv2.imencode(".jpg", frame.image, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()
        self._record.log(_IMAGE, rr.EncodedImage(contents=jpeg, media_type="image/jpeg"))
        table = result.observations.with_new(result.created)
        for label in COLOURS:
            rows = table.labelled(label)
            if label != "new":
                lines = list(search_ellipses(rows.predicted, rows.covariances))
                searched = rr.LineStrips2D(lines, colors=_rgb(label))
                self._record.log(f"{_IMAGE}/{label}/searched", searched)
            found = rows.pixels[np.isfinite(rows.pixels).all(axis=1)]
            points = rr.Points2D(found, colors=_rgb(label), radii=3.0)
            self._record.log(f"{_IMAGE}/{label}/found", points)

    def _show_camera(self, result: Tracked) -> None:
        T_wc, position = result.T_wc, result.T_wc[:3, 3]
        pose = self._rerun.Transform3D(translation=position, mat3x3=T_wc[:3, :3])
        self._record.log("world/camera", pose)
        before = self._before
        joined = before is not None and before.map == result.map
        # Positions in one piece of the path, the last of which is written anew with every frame.
        if not joined or before.lost != result.lost or len(self._positions) >= 100:
            self._piece += 1
            self._positions = self._positions[-1:] if joined else self._positions[:0]
        self._positions = np.vstack([self._positions, position])
        colour = _LOST if result.lost else _TRACKED
        path = self._rerun.LineStrips3D([self._positions], colors=colour)
        self._record.log(f"world/path/{self._piece}", path)

    def _show_graph(self, result: Tracked) -> None:
        """Record where submaps ended, and from which camera a loop leads to which of them."""
        rr, before = self._rerun, self._before
        if before is not None and before.submap != result.submap:
            self._ends[before.submap] = before.T_wc[:3, 3]
            labels = [f"submap {number}" for number in self._ends]
            ends = rr.Points3D([*self._ends.values()], colors=_TRACKED, labels=labels, radii=0.03)
            self._record.log("world/graph/submaps", ends)
        if result.loop in self._ends:
            self._loops.append([result.T_wc[:3, 3], self._ends[result.loop]])
            self._record.log("world/graph/loops", rr.LineStrips3D(self._loops, colors=(213, 94, 0)))

    def _show_numbers(self, result: Tracked) -> None:
        rr, camera = self._rerun, result.camera
        numbers = {
            "nis/per_dof": result.nis / result.nis_dof if result.nis_dof else None,
            "sigma/position": camera.sigma_position,
            "sigma/orientation": camera.sigma_orientation,
            "sigma/log_scale": result.sigma_log_scale,
            "log_scale": result.log_scale,
        }
        for name, number in numbers.items():
            if number is not None:
                self._record.log(name, rr.Scalars(number))
        if self._before is None or self._before.state != result.state:
            text = f"frame {result.index}: {result.state}, map {result.map}"
            self._record.log("state", rr.TextLog(text, level="WARN" if result.lost else "INFO"))


def _rerun() -> ModuleType:
    try:
        import rerun
    except ImportError as error:
        raise missing("a recording needs", "viewer", error) from None
    return rerun


def _layout() -> object:
    """The world beside the picture, the numbers and the states."""
    from rerun import blueprint as b

    beside = b.Vertical(
        b.Spatial2DView(origin=_IMAGE, name="picture"),
        b.TimeSeriesView(origin="nis", name="NIS by its degrees of freedom"),
        b.TimeSeriesView(origin="sigma", name="sigma, of poses in the map's unit"),
        b.TimeSeriesView(origin="log_scale", name="log of the map's unit in metres"),
        b.TextLogView(origin="state", name="state"),
        row_shares=[4, 2, 2, 1, 1],
    )
    world = b.Spatial3DView(origin="world", name="map")
    return b.Blueprint(b.Horizontal(world, beside), collapse_panels=True)


def _rgb(status: str) -> tuple[int, int, int]:
    blue, green, red = COLOURS[status]
    return red, green, blue
