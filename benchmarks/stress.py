"""What makes the tracker fail: where a video starts, disturbed images, frames without end.

    python benchmarks/stress.py starts
    python benchmarks/stress.py starts ../shared/data/kitti06_first51 --starts 8 --frames 40
    python benchmarks/stress.py reference ../shared/data/kitti06_first51
    python benchmarks/stress.py disturbances --only black cut --seeds 3
    python benchmarks/stress.py endurance ../shared/data/monoslam_desk --frames 10000

The settings are those of `jaxslam track`. A *lie* is a frame that is said to be tracked, in the
first map, and of which the NEES beyond scale is that of an error of 5 σ. Each writes a JSON file of
its name; their tables are in `docs/stress.md`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple
from unittest import mock

import cv2
import numpy as np
from benchmark import RESULTS, Benchmark, data_folder, run_one, table
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, norm
from tyro.conf import Positional

from jaxslam.evaluation import errors_beyond_scale
from jaxslam.io.opening import open_source
from jaxslam.io.source import Frame, Source, Trajectory
from jaxslam.statistics.beyond_scale import one_scale
from jaxslam.tracking.policy import Policy
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.synthetic import (
    add_noise,
    handheld_trajectory,
    render,
    room,
    synthetic_source,
)
from jaxslam.tracking.tracker import Tracker
from jaxslam.tracking.trajectory import TRACKED, absolute_trajectory_error

PAGE = "stress.md"
LIE = 2 * norm.sf(5)
"""The share of NEES beyond scale that is larger than that of an error of 5 σ."""


def beyond_scale(
    results: Sequence[Any], which: np.ndarray, truth: np.ndarray, floor: np.ndarray | float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """NEES of some of the poses at their one scale, and its degrees of freedom; `floor` is the
    covariance of the truth."""
    T_wc, P = (np.stack([getattr(results[k], x) for k in which]) for x in ("T_wc", "covariance"))
    fixed = np.array([results[k].unit_fixed for k in which])
    best = errors_beyond_scale(TRACKED, T_wc, truth, P + floor)
    return one_scale(*best, fixed).nees, np.where(fixed, 6, 5)


def reference_of(sequence: Path) -> tuple[Source, Trajectory]:
    """A data set folder, and its reference."""
    source = open_source(sequence)
    if source.reference is None:
        raise SystemExit(f"{sequence}: there is no reference")
    return source, source.reference


# --- starts -------------------------------------------------------------------------------------

REFERENCE = 0.003, np.radians(0.06)
"""σ of the reference's position, of the farthest distance from the start, and orientation. Whether
it is, `reference` says."""
EVERY = 10
"""Frames from one that is looked at to the next."""
STARTS = "<!-- starts -->"


@dataclass(frozen=True, kw_only=True)
class Starts(Benchmark):
    """From many starts of a sequence: how often a tracker is lost, reversed, or believes a lie.

    Starts are spread evenly; each has a tracker of its own.
    """

    sequences: Annotated[tuple[Path, ...], Positional] = ()
    """Data set folders with a reference; by default all there are in $JAXSLAM_DATA."""
    starts: int = 20
    frames: int = 100
    """Frames that are tracked from each; of a video that is not much longer, half of it."""
    filter: str = "recommended"
    out: Path = RESULTS / "starts.json"
    double = False

    def measure(self) -> Iterator[dict[str, Any]]:
        results, there = self.found(), data_folder().glob("*/images")
        for sequence in self.sequences or sorted(path.parent for path in there):
            results[sequence.name] = starts(sequence, self)
            yield results

    def tables(self, results: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
        yield PAGE, STARTS, table_of_starts(results)


class Outcome(NamedTuple):
    """Of one start."""

    tracked: float
    """Share of the frames after the first."""
    maps: int
    sign: float
    error: float
    """Of the first map, % of its path."""
    beyond: float
    """Median NEES beyond scale by its degrees of freedom."""
    lies: float
    """Share of the frames that are looked at."""


def outcome(source: Source, reference: Trajectory, frames, settings: TrackerSettings) -> Outcome:
    """What becomes of a tracker that is given these frames."""
    tracker = Tracker(source.calibration, settings)
    results = [tracker.track(frame) for frame in frames]
    times = np.array([result.time for result in results])
    nearest = np.array([np.argmin(np.abs(reference.times - time)) for time in times])
    truth = np.linalg.inv(reference.T_wc[nearest[0]]) @ reference.T_wc[nearest]
    first = np.array([result.map == 0 for result in results])
    tracked = np.array([result.state == "tracked" for result in results])
    T_wc = np.stack([result.T_wc for result in results])
    looked = np.flatnonzero(first & tracked)
    looked = looked[looked % EVERY == 0]
    whole = Outcome(tracked[1:].mean(), tracker.restarts + 1, np.nan, np.nan, np.nan, np.nan)
    if first.sum() < 3 or not len(looked):
        return whole
    ate = absolute_trajectory_error(times[first], T_wc[first], times[first], truth[first])
    # In the unit of the map: as far as the estimate comes, where the reference does.
    far = np.linalg.norm(T_wc[first, :3, 3], axis=1).max()
    floor = np.diag([(REFERENCE[0] * far) ** 2] * 3 + [REFERENCE[1] ** 2] * 3)
    nees, dof = beyond_scale(results, looked, truth[looked], floor)
    return whole._replace(
        sign=ate["sign"],
        error=100 * ate["rmse"] / ate["path_length"],
        beyond=float(np.median(nees / dof)),
        lies=float(np.mean(chi2.sf(nees, dof) < LIE)),
    )


def starts(sequence: Path, options: Starts) -> dict[str, Any]:
    """Outcomes from all starts of one sequence, printed as they come."""
    source, reference = reference_of(sequence)
    images, settings = list(source), TrackerSettings(filter=options.filter)
    frames = min(options.frames, len(images) // 2)
    begins = np.unique(np.linspace(0, len(images) - frames, options.starts).astype(int))
    print(f"{source.name}\nstart  tracked  maps   sign  error, %  beyond scale  lies")
    line = "{:>5}  {:7.2f}  {:4.1f}  {:5.2f}  {:8.2f}  {:12.2f}  {:4.2f}".format
    found = {}
    for begin in begins.tolist():
        one = outcome(source, reference, images[begin : begin + frames], settings)
        print(line(begin, *one), flush=True)
        found[str(begin)] = [None if np.isnan(x) else round(float(x), 4) for x in one]
    return {"filter": settings.filter, "frames": frames, "starts": found}


def table_of_starts(results: dict[str, dict[str, Any]]) -> str:
    """Of all sequences, as Markdown."""
    header = (
        "sequence", "starts × frames", "tracked; maps", "reversed", "error, median, worst",
        "NEES/dof", "beyond 5 σ",
    )  # fmt: skip
    return table(header, (_of_starts(name, result) for name, result in results.items()))


def _of_starts(name: str, result: dict[str, Any]) -> list[str]:
    of_start = np.array(list(result["starts"].values()), float)
    tracked, maps, sign, error, beyond, lies = of_start.T
    return [
        name,
        f"{len(of_start)} × {result['frames']}",
        f"{tracked.mean():.1%}; {maps.mean():.2g}",
        f"{np.sum(sign < 0)}",
        f"{np.nanmedian(error):.2f} %, {np.nanmax(error):.1f} %",
        f"{np.nanmedian(beyond):.2g}",
        f"{np.nanmean(lies):.1%}",
    ]


# --- reference ----------------------------------------------------------------------------------

CORNERS = 1500
APART = 7.0
"""Pixels between corners."""
RETURNED = 0.3
"""Pixels: a corner that is followed back to farther from where it was is none."""
NEAR = 1.0
"""Pixels from its epipolar line within which a corner agrees."""


def followed(
    before: UInt8[np.ndarray, "h w"], now: UInt8[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "k 1 2"], Float[np.ndarray, "k 1 2"]]:
    """Corners of a picture and where they are in another one."""
    corners = cv2.goodFeaturesToTrack(before, CORNERS, 0.003, APART)
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, now, corners, corners.copy(), maxLevel=5)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(now, before, there, there.copy(), maxLevel=5)
    returned = np.linalg.norm(back - corners, axis=2)[:, 0] < RETURNED
    kept = (found[:, 0] > 0) & (found_back[:, 0] > 0) & returned
    return corners[kept], there[kept]


def turned(
    before: Float[np.ndarray, "k 1 2"], now: Float[np.ndarray, "k 1 2"], K: np.ndarray
) -> tuple[Float[np.ndarray, "3 3"], float]:
    """R of the motion X' = R X + t, and the share of the corners that agree with it."""
    E, near = cv2.findEssentialMat(
        before, now, K, method=cv2.USAC_MAGSAC, prob=0.99999, threshold=NEAR
    )
    _, R, _, _ = cv2.recoverPose(E, before, now, K, mask=near.copy())
    return R, float(np.mean(near > 0))


@dataclass(frozen=True, kw_only=True)
class Reference(Benchmark):
    """What a sequence's pictures say of the orientations of its reference.

    Hundreds of corners are followed from frame to frame, there and back, and the rotation between
    two frames is that of the essential matrix which most of them agree with: no filter, and no
    prior, takes part. Where nearly all agree to a pixel with a rotation that is not the
    reference's, a NEES against that reference measures the reference. Only of pictures between
    which the camera moves: of a short baseline the rotation is not known.
    """

    sequence: Positional[Path]
    """Data set folder with a reference."""
    frames: int = 15
    """Frames that are compared."""
    every: int = 1
    """Frames from one to the next."""
    out: Path = RESULTS / "reference.json"
    double = False

    def measure(self) -> Iterator[dict[str, Any]]:
        """By frame: corners, the share that agrees, and degrees by which the reference is turned
        against the pictures, in this step and since the first frame."""
        source, reference = reference_of(self.sequence)
        K, distortion = source.calibration.matrix, np.array(source.calibration.distortion, float)
        whole, rows = np.eye(3), {}
        compared = [f for f in source if f.index % self.every == 0][: self.frames]
        nearest = [np.argmin(np.abs(reference.times - frame.time)) for frame in compared]
        truth = reference.T_wc[nearest]
        for i in range(1, len(compared)):
            corners = followed(compared[i - 1].image, compared[i].image)
            R, agree = turned(*(cv2.undistortPoints(x, K, distortion, P=K) for x in corners), K)
            whole = R @ whole
            step, since = (np.linalg.inv(truth[i]) @ truth[j] for j in (i - 1, 0))
            degrees = [
                round(np.degrees(Rotation.from_matrix(ours @ T[:3, :3].T).magnitude()), 3)
                for ours, T in ((R, step), (whole, since))
            ]
            rows[str(compared[i].index)] = [len(corners[0]), round(agree, 3), *degrees]
        yield self.found() | {self.sequence.name: rows}


# --- disturbances -------------------------------------------------------------------------------

RATE = 30
DISTURBED = "<!-- disturbances -->"
FIRST_SEED = 150
"""Of the videos; nothing was tried on these."""


class Disturbed(NamedTuple):
    """A video of which the frames `during` are not as they should be."""

    frames: Iterator[Frame]
    T_wc: np.ndarray
    """Where the camera is; NaN where it is in another world."""
    during: range
    wrong: float = 0.0
    """Share of the matches of which the place is any other in the ellipse."""


class Confused:
    """A search that errs while it is `on`, as often as its share says."""

    def __init__(self, share: float, seed: int) -> None:
        self.share, self.on = share, False
        self._rng, self._agreeing = np.random.default_rng(seed), Policy.agreeing

    def agreeing(self, policy, seen, matches, landmarks, agree, *, lost):
        """With wrong places in that of the true ones."""
        if self.on:
            wrong = self._rng.random(len(seen.slots)) < self.share
            pixels = [
                self._elsewhere(seen, owner) if wrong[owner] else pixel
                for owner, pixel in zip(matches.owner, matches.pixels, strict=True)
            ]
            matches = matches._replace(pixels=np.array(pixels).reshape(-1, 2))
        return self._agreeing(policy, seen, matches, landmarks, agree, lost=lost)

    def _elsewhere(self, seen, row):
        angle, radius = self._rng.uniform(0, 2 * np.pi), 3 * np.sqrt(self._rng.random())
        aside = radius * np.array([np.cos(angle), np.sin(angle)])
        return seen.predicted[row] + np.linalg.cholesky(seen.covariances[row]) @ aside


def black(seed: int) -> Disturbed:
    """5 s black."""
    return _video(seed, 330, range(60, 60 + 5 * RATE), lambda frame: np.zeros_like(frame.image))


def cut(seed: int) -> Disturbed:
    """A cut to another room."""
    return _other_room(seed, 180, range(80, 180))


def cut_back(seed: int) -> Disturbed:
    """3 s of another room, and back."""
    return _other_room(seed, 240, range(80, 170))


def hand(seed: int) -> Disturbed:
    """A hand in front, 1.3 s."""
    during = range(60, 100)
    noise = np.random.default_rng(seed).integers(60, 120, (480, 400), dtype=np.uint8)
    skin = cv2.GaussianBlur(noise, (0, 0), 3)

    def covered(frame: Frame) -> np.ndarray:
        image, left = frame.image.copy(), 20 * (frame.index - during.start) - 200
        there = image[:, max(0, left) : left + 400]
        there[:] = skin[:, : there.shape[1]]
        return image

    return _video(seed, 180, during, covered)


def scattered(seed: int) -> Disturbed:
    """Half of the matches wrong, each differently, 4 s."""
    return _video(seed, 180, range(60, 180), wrong=0.5)


def half_wrong(seed: int) -> Disturbed:
    """Half of the image moves differently, 4 s."""
    during, still = range(60, 180), next(iter(_source(180, seed))).image
    pan = np.cumsum(np.random.default_rng(seed).normal(0, 1, 400)) + 1.5 * np.arange(400)

    def partly(frame: Frame) -> np.ndarray:
        image = frame.image.copy()
        aside = int(pan[frame.index] - pan[during.start])
        image[:, :320] = np.roll(still, aside, axis=1)[:, :320]
        return image

    return _video(seed, 180, during, partly)


def ghost(seed: int) -> Disturbed:
    """A double image, 4 s."""

    def doubled(frame: Frame) -> np.ndarray:
        return cv2.addWeighted(frame.image, 0.5, np.roll(frame.image, 37, axis=1), 0.5, 0)

    return _video(seed, 180, range(60, 180), doubled)


def rotation(seed: int) -> Disturbed:
    """Pure rotation, 4 s from the start."""
    during = range(1, 4 * RATE)
    T_wc = handheld_trajectory(np.arange(240) / RATE, seed)
    T_wc[:, :3, 3] = 0
    T_wc[during.stop :, :3, 3] = _set_out(240 - during.stop, seed)[:, :3, 3]
    return Disturbed(_rendered(T_wc, seed), T_wc, during)


def standing(seed: int) -> Disturbed:
    """Standing, 60 s from the start."""
    during = range(1, 60 * RATE)
    T_wc = np.concatenate([np.tile(np.eye(4), (during.stop, 1, 1)), _set_out(90, seed)])
    return Disturbed(_rendered(T_wc, seed), T_wc, during)


def _set_out(count: int, seed: int) -> np.ndarray:
    """Poses of a hand that comes from rest to its speed within a second."""
    pace = np.clip(np.arange(count) / RATE, 0, 1)
    return handheld_trajectory(np.cumsum(3 * pace**2 - 2 * pace**3) / RATE, seed)


DISTURBANCES = {
    of.__name__: of
    for of in (black, cut, cut_back, hand, scattered, half_wrong, ghost, rotation, standing)
}


@dataclass(frozen=True, kw_only=True)
class Disturbances(Benchmark):
    """Where a camera sees what it should not: is a lie believed, and what comes after?

    Synthetic videos whose truth is known exactly. After a cut any frame that is tracked in the
    first map is a lie: the camera is elsewhere.
    """

    only: tuple[str, ...] = tuple(DISTURBANCES)
    seeds: int = 5
    filter: str = "recommended"
    out: Path = RESULTS / "disturbances.json"
    double = False

    def measure(self) -> Iterator[dict[str, Any]]:
        results, settings = self.found(), TrackerSettings(filter=self.filter)
        for name in self.only:
            results[name] = []
            for seed in range(FIRST_SEED, FIRST_SEED + self.seeds):
                results[name].append(survived(DISTURBANCES[name](seed), settings, seed))
                print(name, seed, results[name][-1], flush=True)
            yield results

    def tables(self, results: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
        yield PAGE, DISTURBED, table_of_disturbances(results)


def _source(frames: int, seed: int) -> Source:
    return synthetic_source(frames=frames, seed=seed, rate=RATE)


def _video(
    seed: int, frames: int, during: range, picture: Callable[[Frame], np.ndarray] | None = None,
    *, elsewhere: bool = False, wrong: float = 0.0,
) -> Disturbed:  # fmt: skip
    """The synthetic video of a seed, with other pictures meanwhile."""
    source = _source(frames, seed)
    assert source.reference is not None
    T_wc = source.reference.T_wc.copy()
    if elsewhere:
        T_wc[during.start : during.stop] = np.nan
    changed = (
        replace(frame, image=picture(frame)) if picture and frame.index in during else frame
        for frame in source
    )
    return Disturbed(changed, T_wc, during, wrong)


def _other_room(seed: int, frames: int, during: range) -> Disturbed:
    other = list(_source(frames, seed + 1000))
    return _video(seed, frames, during, lambda f: other[f.index].image, elsewhere=True)


def _rendered(T_wc: np.ndarray, seed: int) -> Iterator[Frame]:
    """The room of a seed from these poses; one that is as the one before is rendered once."""
    calibration = _source(1, seed).calibration
    quads, before, clean = room(seed, calibration.fx), np.full((4, 4), np.nan), None
    for index, pose in enumerate(T_wc):
        if clean is None or not np.array_equal(pose, before):
            before, clean = pose, render(quads, pose, calibration)
        yield Frame(index, index / RATE, add_noise(clean, np.random.default_rng([seed, index])))


def survived(disturbed: Disturbed, settings: TrackerSettings, seed: int) -> dict[str, float]:
    """What becomes of a tracker: shares of the frames meanwhile, and in the last second."""
    tracker = Tracker(_source(1, seed).calibration, settings)
    during = disturbed.during if disturbed.wrong else range(0)
    confused, results = Confused(disturbed.wrong, seed), []
    with mock.patch.object(Policy, "agreeing", lambda *a, **k: confused.agreeing(*a, **k)):
        for frame in disturbed.frames:
            confused.on = frame.index in during
            results.append(tracker.track(frame))
    tracked = np.array([result.state == "tracked" for result in results])
    believed = tracked & [result.map == 0 for result in results]
    index = np.arange(len(results))
    elsewhere = np.isnan(disturbed.T_wc[:, 0, 0])
    lies = believed & elsewhere
    known = np.flatnonzero(believed & ~elsewhere)
    nees, dof = beyond_scale(results, known, disturbed.T_wc[known])
    lies[known] = chi2.sf(nees, dof) < LIE
    during, after = np.isin(index, disturbed.during), index >= disturbed.during.stop
    late = after & (index >= len(index) - RATE)
    back = np.flatnonzero(believed & after)
    return {
        "back_after": float(back[0] - disturbed.during.stop) if len(back) else -1.0,
        "tracked_during": float(tracked[during].mean()),
        "tracked_at_end": float(tracked[late].mean())
        if late.any()
        else float(tracked[-RATE:].mean()),
        "in_first_map_at_end": float(results[-1].map == 0),
        "maps": tracker.restarts + 1,
        "reversed": tracker.reversed,
        "lies": float(lies.sum() / tracked.sum()),
        "beyond_scale": float(np.median(nees / dof)),
    }


def table_of_disturbances(results: dict[str, list[dict[str, float]]]) -> str:
    """As Markdown, a row for each disturbance."""
    header = (
        "disturbance", "videos", "tracked meanwhile", "in the last second", "in the first map",
        "maps", "NEES/dof", "beyond 5 σ",
    )  # fmt: skip
    rows = []
    for name, disturbance in DISTURBANCES.items():
        if of := results.get(name):
            mean = {key: float(np.mean([row[key] for row in of])) for key in of[0]}
            shares = ("tracked_during", "tracked_at_end", "in_first_map_at_end")
            numbers = (f"{mean[key]:.2g}" for key in ("maps", "beyond_scale"))
            words, lies = (disturbance.__doc__ or "").rstrip("."), f"{mean['lies']:.1%}"
            rows.append((words, len(of), *(f"{mean[key]:.0%}" for key in shares), *numbers, lies))
    return table(header, rows)


# --- endurance ----------------------------------------------------------------------------------

BLOCK = 1000
"""Frames of a row."""
ENDURANCE = "<!-- endurance -->"


@dataclass(frozen=True, kw_only=True)
class Endurance(Benchmark):
    """A video that does not end: does a frame cost more, or memory grow, with time?

    The frames of a sequence go to and fro at their own rate. Every thousand frames: the median and
    the 99 % quantile of the CPU time of one, of all threads, the memory of the process, the
    landmarks that left the map, and the error of the path so far.
    """

    sequence: Annotated[Path, Positional] = field(
        default_factory=lambda: data_folder() / "monoslam_desk"
    )
    frames: int = 10_000
    filter: str = "recommended"
    out: Path = RESULTS / "endurance.json"
    double = False

    def measure(self) -> Iterator[dict[str, Any]]:
        """A row for every thousand frames."""
        source = open_source(self.sequence)
        tracker = Tracker(source.calibration, TrackerSettings(filter=self.filter))
        tracker.compile()
        rows, seconds, tracked, cameras = [], [], [], {}
        still = to_and_fro(list(source), self.frames)
        for index, (frame, when) in enumerate(still):
            start = time.process_time()
            result = tracker.track(frame)
            seconds.append(time.process_time() - start)
            tracked.append(result.state == "tracked")
            if tracked[-1] and result.map == 0:
                cameras[index] = when, result.T_wc
            if len(seconds) == BLOCK:
                median, p99 = 1e3 * np.quantile(seconds, [0.5, 0.99])
                row = frame.index + 1, np.mean(tracked), tracker.restarts + 1, median, p99
                row = *row, resident(), tracker.deleted, _error(cameras, source)
                rows.append([round(float(x), 3) for x in row])
                print(rows[-1], flush=True)
                seconds, tracked = [], []
                yield {"sequence": source.name, "filter": tracker.filter_name, "rows": rows}

    def tables(self, results: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
        header = (
            "to frame", "tracked", "maps", "ms of CPU a frame, p99", "memory, MiB",
            "landmarks that left", "error so far, %",
        )  # fmt: skip
        of_row = "{:.0f}|{:.1%}|{:.0f}|{:.1f}, {:.0f}|{:.0f}|{:.0f}|{:.2f}".format
        rows = [of_row(*row).split("|") for row in results["rows"][1::2]]
        yield PAGE, ENDURANCE, table(header, rows)


def _error(cameras: dict[int, tuple[float, np.ndarray]], source: Source) -> float:
    """RMS of all positions of the first map so far, aligned by one Sim(3), in percent of the
    length of the sequence once through; NaN without a reference."""
    if source.reference is None:
        return np.nan
    times, true = source.reference
    pairs = [(T, true[np.argmin(np.abs(times - when))]) for when, T in cameras.values()]
    each = np.arange(len(pairs), dtype=float)
    estimate, reference = (np.array(part) for part in zip(*pairs, strict=True))
    error = absolute_trajectory_error(each, estimate, each, reference)["rmse"]
    return 100 * error / float(np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum())


def to_and_fro(frames: Sequence[Frame], count: int) -> Iterator[tuple[Frame, float]]:
    """So many frames, and when each was taken: the first to the last, back to the first, and so
    on, at an even rate."""
    period = (frames[-1].time - frames[0].time) / (len(frames) - 1)
    there_and_back = [*range(len(frames)), *range(len(frames) - 2, 0, -1)]
    for index in range(count):
        taken = frames[there_and_back[index % len(there_and_back)]]
        yield Frame(index, index * period, taken.image), taken.time


def resident() -> float:
    """Memory of this process that is in use now, MiB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) / 1024


if __name__ == "__main__":
    run_one(Starts, Reference, Disturbances, Endurance)
