"""The tracker: a filter fed with pictures, frame by frame, by active search."""

from __future__ import annotations

import threading
from collections import Counter
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import binom

from jaxslam._numerics.arrays import cast
from jaxslam._runtime.files import one_line
from jaxslam._runtime.programs import Program, in_background
from jaxslam.filters.association import ASSOCIATIONS, Association, candidates, one_point_ransac
from jaxslam.filters.ekf import EkfSlam, check_can_track, init_with_depths
from jaxslam.filters.protocol import AbstractStaged, Scene
from jaxslam.filters.readouts import (
    camera_pose_in_unit,
    landmarks_in_unit,
    landmarks_on_sides,
    log_unit,
)
from jaxslam.geometry import scaled
from jaxslam.io.calibration import Calibration, as_fields, from_fields
from jaxslam.io.pictures import as_grey
from jaxslam.io.source import Frame, check_size
from jaxslam.models.observations import Features, Status
from jaxslam.models.scale import Metre
from jaxslam.models.sensors import Pinhole
from jaxslam.tracking.corners import detect_corners
from jaxslam.tracking.epipolar import MINIMAL, of_one_motion
from jaxslam.tracking.landmarks import NO_POINTS, Landmark, Points, joined, stacked, unstacked
from jaxslam.tracking.map import Prediction, failing, in_view, note_found, to_search, worst_first
from jaxslam.tracking.matching import PEAKS, Match, match_patches
from jaxslam.tracking.patches import Patch
from jaxslam.tracking.pose_with_covariance import PoseWithCovariance
from jaxslam.tracking.resume import grown, leaves, read_record, write_record
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.target import Target, TargetObservation, known_depths, sighted
from jaxslam.tracking.unit import Nearness, lengthened, nearness

LEAST_MATCHES = 4
"""Fewer do not count as having tracked a frame, and are not believed."""
CHANCE = 0.05
"""Of a landmark that is not in the picture to have a match all the same that agrees …"""
BY_CHANCE = 1e-3
"""… and of a frame to be believed although its landmarks are not there."""
ASTRAY = np.radians(10.0)
"""σ of the directions in which landmarks are expected from which on none is believed: one linear
update from there would be wrong, and sure."""
PROVEN = 10
"""A landmark that was found so often is where the map says: one that is then found elsewhere
contradicts it …"""
CONTRADICTED = 0.2
"""… and no frame is believed while more than this share of them do, of at least `PROVEN`, in one
direction: half of the picture may be a lorry's, or the map is wrong. Chance matches have none."""
_LATELY = 3
"""Frames over which that share is an average."""

_NUMBERS = (
    "created", "deleted", "restarts", "reversed", "steps", "_time", "_unmeasured",
    "_sigma_log_scale", "_proven", "_elsewhere", "_log_unit", "_log_scale", "_unit_fixed",
)  # fmt: skip
"""What a tracker counts and measures, one number each."""


@dataclass(frozen=True)
class Tracked:
    """What became of one frame; k landmarks were searched, j created."""

    index: int
    time: float
    camera: PoseWithCovariance
    """The camera in the world, which is the first camera; of a later map, by way of its start. All
    of a map in one unit (docs/gauge.md), and the covariance is of the pose in that unit."""
    predicted: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    """Pixels of the landmarks searched, (k, 2)."""
    search: np.ndarray = field(default_factory=lambda: np.zeros((0, 2, 2)))
    """Their innovation covariances, (k, 2, 2)."""
    matched: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    """Where they were found, (k, 2), NaN where they were not."""
    status: list[str] = field(default_factory=list)
    """`matched`, `unmatched` or `outlier`, k of them."""
    created: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    """Pixels of new landmarks, (j, 2)."""
    nis: float = 0.0
    nis_dof: int = 0
    lost: bool = False
    starts: bool = False
    """Whether a map begins here; where it is not the first, the camera was lost too."""
    map: int = 0
    """Number of the map; each has a unit of length of its own."""
    log_scale: float | None = None
    """Log of the map's unit in metres as the filter now believes it to be, where it has a unit of
    its own: e^log_scale times this pose is what it takes for metres."""
    sigma_log_scale: float | None = None
    """σ of that, where the filter is in doubt of it."""
    unit_fixed: bool = True
    """Whether the filter keeps its unit from here on. While a start is being found out it does not,
    and the map's is carried over by the landmarks' distances, about which no covariance knows."""

    @property
    def T_wc(self) -> np.ndarray:
        """(4, 4)."""
        return self.camera.T_wc

    @property
    def covariance(self) -> np.ndarray:
        """(6, 6) in the right tangent of T_wc: position in camera axes, rotation."""
        return self.camera.covariance

    @property
    def innovations(self) -> Float[np.ndarray, " f"]:
        """Squared innovations `νᵀ S⁻¹ ν` of the f landmarks that were found, before any was tested
        for agreement: of two degrees of freedom each where the prediction is right."""
        found = np.isfinite(self.matched[:, 0])
        off = (self.matched - self.predicted)[found]
        return np.einsum(
            "ki,ki->k", off, np.linalg.solve(self.search[found], off[..., None])[..., 0]
        )

    @property
    def state(self) -> str:
        """`start` of a map, `lost` or `tracked`."""
        return "start" if self.starts else "lost" if self.lost else "tracked"


@dataclass
class Tracker:
    """Tracks a camera: `step(image, time)` or `track(frame)` for each frame of a video, in order.

    A camera that is lost moves as the filter predicts. One lost for long, or a filter whose
    covariance is not positive any more, begins a new map where the picture has the corners for
    it: exactly known in its own frame, and in the world as surely as its start is. Its unit of
    length is another, which no covariance here knows of. Within a map there is one unit, whatever
    the filter makes of the scale meanwhile (docs/gauge.md).

    The mutable part is this object; all mathematics is in pure, jitted functions of the state.
    Raises ValueError for a filter that cannot track, or cannot begin with the target.
    """

    calibration: Calibration
    """Of the camera, for the size of its pictures."""
    settings: TrackerSettings = field(default_factory=TrackerSettings)
    filter: AbstractStaged | None = None
    """One's own, in place of the filter that the settings name."""
    target: Target | None = None
    """Points of known positions, m, that the first frame sees: then the first map is in metres, the
    unit of `nearest_depth`. For an `EkfSlam` in metres, whose depths have nothing in common."""
    sighting: TargetObservation | None = field(default=None, init=False)
    """Where the first frame saw the target."""
    landmarks: dict[int, Landmark] = field(default_factory=dict, init=False)
    """Those in the map, by their slot of the state."""
    created: int = field(default=0, init=False)
    """Landmarks so far."""
    deleted: int = field(default=0, init=False)
    """Those of them that were given up."""
    restarts: int = field(default=0, init=False)
    """Maps begun after the first."""
    steps: int = field(default=0, init=False)
    """Frames given so far."""
    failed: Counter[str] = field(default_factory=Counter, init=False)
    """How many updates ended in which `Status` that says that their result means nothing."""
    reversed: int = field(default=0, init=False)
    """Maps that turned out to lie behind the camera, and were given up."""
    finished: list[Points] = field(default_factory=list, init=False)
    """Landmarks that left the map."""

    def __post_init__(self) -> None:
        if not isinstance(self.calibration, Calibration):
            raise ValueError(
                f"calibration is a {type(self.calibration).__name__}; a Calibration is accepted, "
                "which `jaxslam.io.calibration.read_calibration` reads from a file"
            )
        made = self.settings.make_filter(self.calibration) if self.filter is None else self.filter
        check_can_track(made, self.filter_name)
        assert isinstance(made, AbstractStaged)
        if self.target is not None and not _keeps_metres(made):
            raise ValueError(
                f"filter {self.filter_name} cannot begin with a target: one that is an EkfSlam, "
                "without a scale of its own, as `world` and `robocentric` are, is accepted"
            )
        if self.target is not None and len(self.target.points) > self.settings.wanted:
            raise ValueError(
                f"the target has {len(self.target.points)} points, and {self.settings.wanted} "
                "landmarks are wanted"
            )
        self._time: float | None = None
        self._origin = self._camera = PoseWithCovariance()
        self._log_unit = self._log_scale = 0.0
        self._sigma_log_scale: float | None = None
        self._unit_fixed = True
        self._near: Nearness = {}
        self._unmeasured = 0
        self._proven = self._elsewhere = 0.0
        self._sets_out = made.ambiguous_start
        with jax.enable_x64(True):
            self._slam: AbstractStaged = cast(made, jnp.float64)
            self._state = self._empty_state()

    @property
    def filter_name(self) -> str:
        """As in the settings, or of the class of one's own."""
        return self.settings.filter if self.filter is None else type(self.filter).__name__

    def track(self, frame: Frame) -> Tracked:
        """Predict, search, update, and renew the map. Raises ValueError, and changes nothing, for
        a frame of another size than the calibration's, or not later than the one before."""
        self._check(frame)
        with jax.enable_x64(True):
            tracked = self._first(frame) if self._time is None else self._next(frame)
        self.steps += 1
        return tracked

    def step(self, image: Any, time: float) -> Tracked:
        """`track` a picture taken at `time` (s): grey, or in colour in OpenCV's order (BGR), uint8
        or floats from 0 to 1."""
        return self.track(Frame(self.steps, float(time), as_grey(image)))

    def compile(self) -> None:
        """Compile all programs now; else the first frames wait for it, and a camera does not."""
        with jax.enable_x64(True):
            for thread in self._prepared():
                thread.join()

    def _prepared(self) -> list[threading.Thread]:
        """Have all programs compiled by two threads, in the order in which they are needed."""
        slam, state, new, dt = self._slam, self._state, self._nothing(), jnp.zeros(())
        gone = jnp.zeros(self.settings.capacity, bool)

        def believed(in_wide: Association | None) -> None:
            predicted, _ = _predict.compile(slam, state, dt)
            nothing = np.zeros(0, int), np.zeros((0, 2))
            _believed.compile(*self._belief(predicted, dt, *nothing, in_wide))

        def corrected() -> None:
            predicted, _ = _predict.compile(slam, state, dt)
            _correct.compile(slam, predicted[0], dt, new)

        return [
            in_background(
                lambda: _begin_map.compile(slam, state, new),
                *(partial(believed, one) for one in (*self._in_wide, None)),
                lambda: _renew_map.compile(slam, state, new),
                self.camera,
            ),
            in_background(
                corrected,
                lambda: _world_points.compile(slam, state, self.settings.capacity),
                lambda: _remove.compile(slam, state, gone),
            ),
        ]

    def _check(self, frame: Frame) -> None:
        check_size(f"frame {frame.index}", frame.image, self.calibration)
        before = -np.inf if self._time is None else self._time
        if not before < frame.time < np.inf:
            raise ValueError(
                f"frame {frame.index}: its time, {frame.time} s, is not later than the one before, "
                f"{before} s"
            )

    def points(self) -> Points:
        """All landmarks, those gone included."""
        with jax.enable_x64(True):
            kept = [*self.finished, self._recorded(sorted(self.landmarks))]
        return joined(kept)

    def camera(self) -> tuple[str, np.ndarray, np.ndarray] | None:
        """How the calibration is treated, and fx, fy, cx, cy with their covariance, pixels, as far
        as this map tells. None of a filter of one's own without a pinhole camera."""
        inner = self._slam.unwrapped
        if not isinstance(inner, EkfSlam) or not isinstance(inner.sensor, Pinhole):
            return None
        with jax.enable_x64(True):
            mean, covariance = jax.device_get(_intrinsics(self._slam, inner, self._state))
        return inner.calibration.name, mean, covariance

    def save(self, path: str | Path) -> None:
        """Write all that is needed to go on from here (.npz), whole or not at all.

        Raises ValueError before the first frame, when there is nothing to go on from.
        """
        if self._time is None:
            raise ValueError("a tracker that was given no frame yet has nothing to save")
        header = {
            "calibration": as_fields(self.calibration),
            "settings": asdict(self.settings),
            "filter": None if self.filter is None else self.filter_name,
            "numbers": {name: getattr(self, name) for name in _NUMBERS},
            "failed": dict(self.failed),
        }
        poses = self._origin, self._camera
        arrays = {
            **leaves(self._state, "state"),
            **leaves([(pose.T_wc, pose.covariance) for pose in poses], "poses"),
            **stacked(self.landmarks),
            **joined([NO_POINTS, *self.finished])._asdict(),
        }
        write_record(path, header, arrays)

    @classmethod
    def load(cls, path: str | Path, filter: AbstractStaged | None = None) -> Tracker:
        """The tracker that was saved, which goes on as that would have: digit by digit.

        One with a filter of one's own is to be given that again. Raises ValueError for a file
        that is none, or of another filter.
        """
        header, arrays = read_record(path)
        if header.get("filter") is not None and filter is None:
            raise ValueError(f"{path}: was saved with a filter {header['filter']}; give that")
        try:
            settings = TrackerSettings(**header["settings"])
        except TypeError:
            raise ValueError(f"{path}: was saved by another version, with other settings") from None
        except KeyError:
            raise ValueError(f"{path}: is damaged: it has no settings") from None
        try:
            return cls._restored(settings, header, arrays, filter)
        except (KeyError, TypeError, IndexError, AttributeError) as error:
            raise ValueError(f"{path}: is damaged ({one_line(error)})") from None

    @classmethod
    def _restored(
        cls,
        settings: TrackerSettings,
        header: dict[str, Any],
        arrays: dict[str, np.ndarray],
        filter: AbstractStaged | None,
    ) -> Tracker:
        """What `save` wrote, as it was."""
        tracker = cls(from_fields(header["calibration"]), settings, filter)
        for name, value in header["numbers"].items():
            setattr(tracker, name, value)
        tracker.failed.update(header["failed"])
        tracker.landmarks = unstacked(arrays)
        tracker.finished = [Points(*(arrays[name] for name in Points._fields))]
        tracker._origin, tracker._camera = (
            PoseWithCovariance(arrays[f"poses/{i}"], arrays[f"poses/{i + 1}"]) for i in (0, 2)
        )
        with jax.enable_x64(True):
            tracker._state = grown(tracker._state, arrays, "state")
            tracker._near = tracker._nearness()
        return tracker

    def _first(self, frame: Frame) -> Tracked:
        self._prepared()
        corners = self._corners(frame)
        created = (
            self._begun(frame, corners) if self.target is None else self._known(frame, corners)
        )
        self._time = frame.time
        return self._tracked(frame, created=created, starts=True)

    def _known(self, frame: Frame, corners: np.ndarray) -> np.ndarray:
        """`_begun` at the target's points, which come first, and at corners away from them."""
        assert self.target is not None
        s = self.settings
        seen = sighted(self.target, frame.image, self.calibration, s.pixel_sigma)
        distances = np.linalg.norm(corners[:, None] - seen.pixels, axis=2)
        apart = corners[np.all(distances >= s.spacing, axis=1)]
        pixels = np.concatenate([seen.pixels, apart])[: s.wanted]
        depths = known_depths(seen, s.wanted, float(s.depth.mean), float(s.depth.sigma))
        self.sighting = seen
        return self._created(
            partial(_begin_known, jax.tree.map(jnp.asarray, depths)), frame, pixels
        )

    def _next(self, frame: Frame) -> Tracked:
        # A number of Python's would be compiled into the programs.
        dt = jnp.asarray(frame.time - (self._time or 0.0))
        predicted, prediction = _predict(self._slam, self._state, dt)
        prediction = jax.device_get(prediction).enlarged(np.exp(self._log_unit))
        prediction = prediction._replace(T_wc=self._origin.T_wc @ prediction.T_wc)
        ahead, behind = prediction.sides
        if behind > ahead and behind >= LEAST_MATCHES:
            return self._turned_round(frame, predicted, dt)
        slots, affines = to_search(self.landmarks, prediction, self.calibration, self.settings)
        found = self._search(frame, prediction, slots, affines)
        if self._astray(prediction.covariances[slots]):
            agreed = matched = np.full((len(slots), 2), np.nan)
        else:
            agreed, matched = self._agreed(predicted, dt, slots, found)
            if self._contradicted(slots, matched - prediction.pixels[slots], agreed):
                agreed = np.full_like(agreed, np.nan)
        features = _padded(slots, agreed, self.settings.wanted)
        state, result = _correct(self._slam, predicted[0], dt, features)
        used, nis, nis_dof, status = jax.device_get(result)
        self._time = frame.time
        if status >= Status.NOT_POSITIVE:
            self.failed[Status(int(status)).name.lower()] += 1
            self._fall_back(predicted, dt)
            return self._lost(frame)
        self._state = state
        used = used[: len(slots)]
        note_found(self.landmarks, slots, used, agreed, self.settings)
        self._remove(failing(self.landmarks, self.settings))
        pixels = prediction.pixels[slots]
        searched = dict(
            predicted=pixels,
            search=prediction.covariances[slots],
            matched=matched,
            status=[
                "matched" if ok else "outlier" if places else "unmatched"
                for places, ok in zip(found, used, strict=True)
            ],
        )
        lost = not used.any()
        self._unmeasured = self._unmeasured + 1 if lost else 0
        if not self.landmarks or self._unmeasured > self.settings.lost_for:
            return self._lost(frame, **searched)
        here = in_view(self.landmarks, slots, self.settings)
        # What a lost camera sees may be another place: it is not put into this map.
        corners = np.zeros((0, 2))
        if not lost:
            corners = self._corners(frame, np.where(used[:, None], matched, pixels)[here])
        self._make_room(len(corners), slots[here])
        created = self._renewed(frame, corners)
        return self._tracked(
            frame,
            **searched,
            created=created,
            nis=float(nis),
            nis_dof=int(nis_dof),
            lost=lost,
        )

    def _agreed(
        self, predicted: tuple[Any, Any], dt: jax.Array, slots: np.ndarray, found: list[list[Match]]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Pixels of the landmarks whose matches agree, if they are more than chance, and of all
        that were found; NaN of the others."""
        owner = np.repeat(np.arange(len(slots)), [len(places) for places in found])
        pixels = np.array([match.pixel for places in found for match in places]).reshape(-1, 2)
        matched = _of_first(owner, pixels, len(slots))
        least = _more_than_chance(len(slots))
        if self._unmeasured:
            # A camera that was lost searches ever wider, and something always looks alike.
            least = max(least, len(slots) // 2)
        if len(owner) > len(np.unique(owner)):
            agreed = self._of_several(predicted, dt, slots, owner, pixels, least)
        else:
            believed = self._believed(predicted, dt, slots[owner], pixels)
            agreed = _of_first(owner[believed], pixels[believed], len(slots))
        if np.isfinite(agreed[:, 0]).sum() < least:
            agreed[:] = np.nan
        return agreed, np.where(np.isfinite(agreed), agreed, matched)

    def _contradicted(
        self, slots: np.ndarray, moved: Float[np.ndarray, "k 2"], agreed: Float[np.ndarray, "k 2"]
    ) -> bool:
        """Whether too many proven landmarks are found elsewhere than those that agree; `moved` is
        where all were found from where they were expected, NaN of those that were not."""
        agree = np.isfinite(agreed[:, 0])
        if agree.any():
            proven = np.array([self.landmarks[slot].found >= PROVEN for slot in slots], bool)
            proven &= np.isfinite(moved[:, 0])
            aside = moved[proven & ~agree] - np.median(moved[agree], axis=0)
            directions = aside / np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 1e-9)
            self._proven += (proven.sum() - self._proven) / _LATELY
            alike = float(np.linalg.norm(directions.sum(axis=0)))
            self._elsewhere += (alike - self._elsewhere) / _LATELY
        return bool(self._elsewhere > CONTRADICTED * max(self._proven, PROVEN))

    def _of_several(
        self,
        predicted: tuple[Any, Any],
        dt: jax.Array,
        slots: np.ndarray,
        owner: np.ndarray,
        pixels: np.ndarray,
        least: int,
    ) -> np.ndarray:
        """Pixels that agree, of landmarks with several places each, if they are `least` at least.

        Where ellipses are wide, depth and direction make of a prediction what is not linear: those
        that agree but for that, and with one motion, are what a linear test is given. One that puts
        out most of them is not believed: the filter `ambiguous_start`.
        """
        for association in self._in_wide:
            believed = self._believed(predicted, dt, slots[owner], pixels, association)
            places = np.flatnonzero(believed)
            lately, rigid = self._rigid(slots[owner[places]], pixels[places])
            tested = places[_alone(owner[places], rigid | ~lately)]
            rigid = np.isin(tested, places[rigid])
            linear = self._believed(predicted, dt, slots[owner[tested]], pixels[tested])
            predictable = 2 * (linear & rigid).sum() >= rigid.sum()
            best = tested[linear if predictable else rigid]
            if len(best) >= least + (0 if predictable else MINIMAL):
                return _of_first(owner[best], pixels[best], len(slots))
        return np.full((len(slots), 2), np.nan)

    def _rigid(self, slots: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which landmarks were seen when any was seen last, and which of these agree with one
        motion since then."""
        s = self.settings
        unseen = np.array([self.landmarks[slot].unseen for slot in slots], int)
        before = np.array([self.landmarks[slot].seen_at for slot in slots]).reshape(-1, 2)
        lately = unseen == unseen.min(initial=unseen.max(initial=0))
        rigid = np.zeros_like(lately)
        rigid[lately] = of_one_motion(
            before[lately], pixels[lately], self.calibration, s.tolerance * s.pixel_sigma
        )
        return lately, rigid

    @property
    def _in_wide(self) -> dict[Association, None]:
        """The associations that are tried where ellipses are wide: the quick one first."""
        if not self._sets_out:
            return {}
        return dict.fromkeys((one_point_ransac, ASSOCIATIONS[self.settings.association]))

    def _believed(
        self,
        predicted: tuple[Any, Any],
        dt: jax.Array,
        slots: np.ndarray,
        pixels: np.ndarray,
        in_wide: Association | None = None,
    ) -> np.ndarray:
        """Which matches the filter believes, by an association for wide ellipses or the usual."""
        belief = self._belief(predicted, dt, slots, pixels, in_wide)
        return np.asarray(_believed(*belief))[: len(slots)]

    def _belief(
        self,
        predicted: tuple[Any, Any],
        dt: jax.Array,
        slots: np.ndarray,
        pixels: np.ndarray,
        in_wide: Association | None = None,
    ) -> tuple[Any, ...]:
        """What `_believed` is given."""
        s, wide = self.settings, in_wide is not None
        features = _padded(slots, pixels, s.wanted * (PEAKS if wide else 1))
        tolerance = jnp.asarray(s.tolerance * s.pixel_sigma)
        association = ASSOCIATIONS[s.association] if in_wide is None else in_wide
        return self._slam, association, wide, *predicted, dt, features, tolerance

    def _astray(self, ellipses: Float[np.ndarray, "k 2 2"]) -> bool:
        """Whether most landmarks are expected too widely."""
        if not len(ellipses):
            return False
        longest = np.sqrt(np.linalg.eigvalsh(ellipses)[:, -1])
        return bool(np.median(longest) > ASTRAY * self.calibration.fx)

    def _turned_round(self, frame: Frame, predicted: tuple[Any, Any], dt: jax.Array) -> Tracked:
        """The map lies behind the camera: another one is begun."""
        self.reversed += 1
        self._time = frame.time
        self._state, _ = _correct(self._slam, predicted[0], dt, self._nothing())
        return self._lost(frame)

    def _nothing(self) -> Features:
        return _padded(np.zeros(0, int), np.zeros((0, 2)), self.settings.wanted)

    def _fall_back(self, predicted: tuple[Any, Any], dt: jax.Array) -> None:
        """The covariance is no longer positive: what prediction alone says of the camera.

        Where that is broken too, the camera is as far from where it was last as the prior on a
        start's velocity lets it be. The landmarks are those of the frame before.
        """
        self._remove(sorted(self.landmarks))
        nothing = self._nothing()
        state, result = _correct(self._slam, predicted[0], dt, nothing)
        if int(result[-1]) >= Status.NOT_POSITIVE:
            self._origin = self._camera
            self._log_unit = -self._log_scale  # of the empty state, which is in metres
            predicted, _ = _predict(self._slam, self._empty_state(), dt)
            state, _ = _correct(self._slam, predicted[0], dt, nothing)
        self._state = state

    def _lost(self, frame: Frame, **searched) -> Tracked:
        """Begin a new map at the camera as it is predicted, or wait for a picture with corners."""
        corners = self._corners(frame)
        self._renewed(frame, corners[:0])
        if len(corners) < LEAST_MATCHES:
            return self._tracked(frame, **searched, lost=True)
        self._remove(sorted(self.landmarks))
        self.restarts += 1
        self._origin, self._state = self._camera, self._empty_state()
        created = self._begun(frame, corners)
        return self._tracked(frame, **searched, created=created, lost=True, starts=True)

    def _empty_state(self) -> Any:
        return _empty(self._slam, self.settings.capacity)

    def _search(
        self, frame: Frame, prediction: Prediction, slots: np.ndarray, affines: np.ndarray
    ) -> list[list[Match]]:
        if not len(slots):
            return []
        templates = np.stack(
            [
                self.landmarks[slot].patch.warped(affine)
                for slot, affine in zip(slots, affines, strict=True)
            ]
        )
        pixels, covariances = prediction.pixels[slots], prediction.covariances[slots]
        # One linear update from matches that no linear prediction expects would be wrong, and sure.
        several = self._sets_out
        return match_patches(frame.image, templates, pixels, covariances, several=several)

    def _remove(self, slots: list[int]) -> None:
        if slots:
            self._give_up(slots, self._recorded(slots))

    def _make_room(self, count: int, kept: np.ndarray) -> None:
        """Give up landmarks, those `kept` apart, until there are slots for so many new ones."""
        missing = count + len(self.landmarks) - self.settings.capacity
        if missing <= 0:
            return
        slots = np.setdiff1d(list(self.landmarks), kept)
        points = self._recorded(slots.tolist())
        candidates = [self.landmarks[slot] for slot in slots]
        worst = worst_first(candidates, points, self.settings)[:missing]
        self._give_up(slots[worst].tolist(), points.only(worst))

    def _give_up(self, slots: list[int], recorded: Points) -> None:
        self.finished.append(recorded)
        self.deleted += len(slots)
        for slot in slots:
            del self.landmarks[slot]
        gone = np.isin(np.arange(self.settings.capacity), slots)
        self._state = _remove(self._slam, self._state, jnp.asarray(gone))

    def _corners(self, frame: Frame, occupied: np.ndarray | None = None) -> np.ndarray:
        """Where the picture is bare; for a whole map where nothing says what is `occupied`."""
        s = self.settings
        wanted = s.wanted
        if occupied is not None:
            wanted = min(s.new_per_frame, s.wanted - len(occupied))
        if wanted <= 0:
            return np.zeros((0, 2))
        return detect_corners(
            frame.image,
            wanted,
            occupied=np.zeros((0, 2)) if occupied is None else occupied,
            min_distance=s.spacing,
            border=2 * s.border,
        ).astype(float)

    def _begun(self, frame: Frame, corners: np.ndarray) -> np.ndarray:
        """Landmarks at the corners, in a state that has none; the corners. Frame 0 of a map."""
        self._unmeasured = 0
        self._proven = self._elsewhere = 0.0
        return self._created(_begin_map, frame, corners)

    def _renewed(self, frame: Frame, corners: np.ndarray) -> np.ndarray:
        """New landmarks at the corners; the corners. Ends the filter's frame."""
        return self._created(_renew_map, frame, corners)

    def _created(self, function: Any, frame: Frame, corners: np.ndarray) -> np.ndarray:
        s = self.settings
        free = [slot for slot in range(s.capacity) if slot not in self.landmarks]
        slots = np.array(free[: len(corners)], int)
        new = _padded(slots, corners, s.wanted)
        self._state, reported = function(self._slam, self._state, new)
        self._locate(*jax.device_get(reported), begins=function is not _renew_map)
        for slot, corner in zip(slots, corners, strict=True):
            patch = Patch.take(frame.image, corner)
            self.landmarks[int(slot)] = Landmark(self.created, patch, self._camera.T_wc, corner)
            self.created += 1
        self._near = self._nearness()
        return corners

    def _locate(self, pose, covariance, log_scale, variance, fixed, *, begins: bool) -> None:
        """Take over what the filter says of its camera, in its unit, and of that unit."""
        if begins:
            self._log_unit = float(log_scale)
        elif not self._unit_fixed:
            found = [one.number for one in self.landmarks.values() if one.found]
            self._log_unit += lengthened(self._near, self._nearness(), found)
        self._unit_fixed = bool(fixed)
        here = PoseWithCovariance(pose, covariance).scaled(np.exp(self._log_unit))
        self._camera = self._origin.then(here)
        self._log_scale = float(log_scale) - self._log_unit
        self._sigma_log_scale = float(np.sqrt(variance)) if variance > 0 else None

    def _nearness(self) -> Nearness:
        """Of all landmarks, as long as the filter's unit is not fixed."""
        if self._unit_fixed:
            return {}
        points, _ = jax.device_get(_world_points(self._slam, self._state, self.settings.capacity))
        return nearness({slot: one.number for slot, one in self.landmarks.items()}, points)

    def _recorded(self, slots: list[int]) -> Points:
        seen = jax.device_get(_world_points(self._slam, self._state, self.settings.capacity))
        unit = np.exp(self._log_unit)
        points, covariances = seen[0][slots] * unit, seen[1][slots] * unit**2
        numbers = np.array([self.landmarks[slot].number for slot in slots], int)
        maps = np.full_like(numbers, self.restarts)
        _, in_map = PoseWithCovariance(self._origin.T_wc).points(points, covariances)
        return Points(numbers, maps, *self._origin.points(points, covariances), in_map)

    def _tracked(self, frame: Frame, **found) -> Tracked:
        return Tracked(
            frame.index,
            frame.time,
            self._camera,
            map=self.restarts,
            log_scale=None if self._sigma_log_scale is None else self._log_scale,
            sigma_log_scale=self._sigma_log_scale,
            unit_fixed=self._unit_fixed,
            **found,
        )


def _keeps_metres(slam: AbstractStaged) -> bool:
    """Whether depths in metres can be told to a filter, landmark by landmark."""
    return isinstance(slam, EkfSlam) and isinstance(slam.scale, Metre) and slam.depth.common is None


def _more_than_chance(searched: int) -> int:
    """Matches of so many landmarks searched that do not agree by chance."""
    return max(LEAST_MATCHES, int(binom.isf(BY_CHANCE, searched, CHANCE)) + 1)


def _alone(owner: np.ndarray, among: np.ndarray) -> np.ndarray:
    """Those among these whose owner has no other one there."""
    some = np.flatnonzero(among)
    _, of, count = np.unique(owner[some], return_inverse=True, return_counts=True)
    return some[count[of] == 1]


def _of_first(owner: np.ndarray, pixels: np.ndarray, count: int) -> Float[np.ndarray, "count 2"]:
    """The first pixel of each owner, NaN of those that have none."""
    first = np.full((count, 2), np.nan)
    first[owner[::-1]] = pixels[::-1]
    return first


def _padded(slots: np.ndarray, pixels: np.ndarray, size: int) -> Features:
    """Features of fixed number; NaN pixels and padding are not valid."""
    missing = size - len(slots)
    valid = np.pad(np.isfinite(pixels).all(axis=1), (0, missing))
    pixels = np.pad(np.nan_to_num(pixels), ((0, missing), (0, 0)))
    return Features(
        jnp.asarray(np.pad(slots, (0, missing))), jnp.asarray(pixels), jnp.asarray(valid)
    )


@Program
def _empty(slam: AbstractStaged, capacity: int) -> Any:
    return slam.init(capacity)


@Program
def _remove(slam: AbstractStaged, state: Any, gone: Any) -> Any:
    return slam.remove(state, gone)


@Program
def _predict(slam: AbstractStaged, state: Any, dt: Any) -> tuple[tuple[Any, Any], Prediction]:
    """The predicted state, as it is and as one Gaussian, and what that expects to see, in the
    filter's own unit."""
    slots = jnp.arange(slam.in_map(state).size)
    state = slam.predict(state, dt)
    one, gaussian = slam.gaussian(state, dt)
    seen = one.predict_features(gaussian, dt, slots)
    usable = seen.possible & jnp.isfinite(seen.covariance).all(axis=(1, 2))
    metres = jnp.exp(log_unit(one, gaussian))
    pose, omegas = scaled(seen.pose, 1 / metres).as_matrix(), metres * seen.omegas
    sides = landmarks_on_sides(one, gaussian, slots)
    prediction = Prediction(
        seen.measured, seen.covariance, usable, pose, seen.points, omegas, sides
    )
    return (state, gaussian), prediction


@Program
def _believed(
    slam: AbstractStaged,
    association: Association,
    wide: bool,
    state: Any,
    gaussian: Any,
    dt: Any,
    features: Features,
    tolerance: Any,
) -> Bool[jax.Array, " m"]:
    one, _ = slam.gaussian(state, dt)
    return association(candidates(one, gaussian, dt, features, tolerance, curved=wide))


@Program
def _correct(
    slam: AbstractStaged, state: Any, dt: Any, features: Features
) -> tuple[Any, tuple[Any, ...]]:
    state, innovation = slam.update(state, dt, features)
    state = slam.compose(state, dt)
    return state, (innovation.used, innovation.nis, innovation.nis_dof, innovation.status)


@Program
def _begin_map(slam: AbstractStaged, state: Any, new: Features):
    state = slam.init(slam.in_map(state).size, new)
    return state, _reported(slam, state)


@Program
def _begin_known(depths: Any, slam: EkfSlam, state: Any, new: Features):
    state = init_with_depths(slam, slam.in_map(state).size, new, depths)
    return state, _reported(slam, state)


@Program
def _renew_map(slam: AbstractStaged, state: Any, new: Features):
    state = slam.close(state, new)
    return state, _reported(slam, state)


def _reported(slam: AbstractStaged, state: Any):
    """T_BC in the filter's unit and its covariance, mean and variance of the log of that unit in
    metres, and whether it is fixed."""
    seen = camera_pose_in_unit(slam, state)
    return seen.pose.as_matrix(), *seen[1:], slam.unit_fixed(state)


@Program
def _intrinsics(slam: AbstractStaged, inner: EkfSlam, state: Any):
    def intrinsics(scene: Scene):
        sensor = inner.calibration.sensor(inner.sensor, scene.core.calibration)
        assert isinstance(sensor, Pinhole)
        return sensor.camera.intrinsics

    return slam.marginal(state, intrinsics)


@Program
def _world_points(slam: AbstractStaged, state: Any, capacity: int):
    return landmarks_in_unit(slam, state, jnp.arange(capacity))
