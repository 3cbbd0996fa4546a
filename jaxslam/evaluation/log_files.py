"""The verdict on logs in files: arrays in npz or CSV; trajectories, covariances, truths; bags."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, TypeAlias, TypedDict

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.evaluation.alignment import MAX_TIME_DIFFERENCE, associated
from jaxslam.evaluation.convention import (
    CHOICES,
    MIXED,
    Convention,
    CovarianceText,
    geometry_of,
    read_covariances,
)
from jaxslam.evaluation.inputs import exactly_known, of_sigmas, read_csv, read_npz
from jaxslam.evaluation.poses import evaluate_poses
from jaxslam.evaluation.result import Evaluation, advice, evaluate, evaluate_nees
from jaxslam.io import ros
from jaxslam.io.tum import WITH_COVARIANCE, check_seconds, width

_CONTENTS = (
    "errors and covariances, innovations and covariances, or estimates, covariances and truths "
    "(or σ instead of covariances), or nees or nis with dof"
)
_ALONE = ("nees", "nis")


class PoseOptions(TypedDict):
    """The options for evaluating poses, see `evaluate_poses`."""

    align: str
    axes_used: str | Sequence[str]
    truth_sigma: Sequence[float] | None


def evaluate_log(
    source: str | Path,
    *,
    covariance: str | Path | None = None,
    truth: str | Path | None = None,
    estimate: str | None = None,
    stated: Mapping[str, str] | None = None,
    align: str = "none",
    axes_used: str | Sequence[str] = (),
    nis: bool = False,
    truth_sigma: Sequence[float] | None = None,
    innovations: str | Path | None = None,
) -> Evaluation:
    """The verdict on what a file or a folder holds.

    `source` is an npz file of arrays, a CSV file of `run, step, errors, upper triangle` lines, a
    trajectory in TUM format with its `covariance` and `truth`, or a folder. A folder has a run of
    `estimate.txt`, `covariance.txt` and `truth.txt`, or one per sub-folder, or ROS bags. The topics
    of a bag are named by `estimate` and `truth` where several fit. Where the tracker's
    `frames.csv` is beside a trajectory, its longest map is evaluated, without frames that are lost
    or whose unit was not fixed yet. What is `stated` of the convention (`error`, `axes`, `order`,
    `scale`) comes before what the files say. For the alignment of poses, the axes used and the
    σ of the truth see `evaluate_poses`. With `nis` errors are innovations. The
    `innovations` of the same filter, in an npz or CSV file, say what to turn (`advice`), and so do
    those alone. Text files may be of other programs (`jaxslam.io.tum.read_log`,
    `read_covariances`). Raises ValueError, naming the file.
    """
    if innovations is not None:
        if nis:
            raise ValueError("give --nis or --innovations FILE, not both")
        beside = evaluate_log(innovations, nis=True)
        own = evaluate_log(
            source, covariance=covariance, truth=truth, estimate=estimate, stated=stated,
            align=align, axes_used=axes_used, truth_sigma=truth_sigma,
        )  # fmt: skip
        told = f"{beside.headline.partition(':')[0]} (of innovations); {advice(beside, own)}"
        return replace(own, notes=(*own.notes, told))
    (source, topic), stated = ros.bag_and_topic(source) or (Path(source), ""), dict(stated or {})
    estimate = estimate or topic or None
    how: PoseOptions = {"align": align, "axes_used": axes_used, "truth_sigma": truth_sigma}
    if not source.exists():
        raise ValueError(f"{source}: no such file or folder")
    if source.suffix in (".npz", ".csv"):
        for name, value in (("covariance", covariance), ("truth", truth), ("estimate", estimate)):
            if value is not None:
                raise ValueError(f"{source}: --{name} goes with a trajectory, not with arrays")
        is_npz = source.suffix == ".npz"
        arrays, runs, steps = (read_npz(source), (), ()) if is_npz else read_csv(source)
        found = named(source, lambda: _evaluate_arrays(arrays, stated, how, nis), runs, steps)
        told = (advice(found),) if found.quantity == "NIS" and found.names else ()
        return replace(found, run_names=runs, notes=(*found.notes, *told))
    if nis:
        raise ValueError(
            f"{source}: innovations must be in an npz or CSV file, not in a trajectory"
        )
    return evaluate_runs(source, runs_of(source, covariance, truth, estimate), stated, how)


def _evaluate_arrays(
    arrays: dict[str, np.ndarray], stated: dict[str, str], how: PoseOptions, nis: bool
) -> Evaluation:
    """The verdict on errors, innovations or poses, by the names of the arrays."""
    held = [name for name in (*_ALONE, "errors", "innovations", "estimates") if name in arrays]
    if "sigmas" in arrays and "covariances" not in arrays:
        arrays = {**arrays, "covariances": of_sigmas(arrays["sigmas"])}
    of_poses = ["truths"] if held == ["estimates"] else []
    needed = {"dof"} if held and held[0] in _ALONE else {"covariances", *of_poses}
    if len(held) != 1 or not needed <= arrays.keys():
        raise ValueError(f"contains {', '.join(arrays)}; expected {_CONTENTS}")
    times = arrays.get("times")
    if held[0] in _ALONE:
        _refuse_options(stated, how)
        quantity = "NIS" if nis else held[0].upper()
        return evaluate_nees(arrays[held[0]], _whole(arrays["dof"]), times=times, quantity=quantity)
    P = arrays["covariances"]
    if held == ["estimates"]:
        said = {name: str(arrays[name]) for name in CHOICES if name in arrays}
        convention = stated_before(said, stated)
        truths = arrays["truths"]
        return evaluate_poses(arrays["estimates"], P, truths, convention, times=times, **how)
    _refuse_options(stated, how)
    quantity = "NIS" if nis or held == ["innovations"] else "NEES"
    names = [str(name) for name in np.ravel(arrays.get("names", ()))]
    return evaluate(arrays[held[0]], P, times=times, names=names, quantity=quantity)


def _whole(number: np.ndarray) -> int:
    """The whole number that an array holds, or 0."""
    told = number.ravel()[0] if number.size == 1 and number.dtype.kind in "iuf" else 0.5
    return int(told) if np.isfinite(told) and told % 1 == 0 else 0


def _refuse_options(stated: dict[str, str], how: PoseOptions) -> None:
    if stated or how["align"] != "none" or how["axes_used"] or how["truth_sigma"] is not None:
        raise ValueError(
            "a convention, an alignment, axes used and σ of the truth apply to poses, but the "
            "file has errors; give estimates, covariances and truths instead"
        )


ESTIMATES = ("estimate.txt", "trajectory.txt", "state_estimate.txt")
COVARIANCES = ("covariance.txt", "state_deviation.txt")
TRUTHS = ("truth.txt", "groundtruth.txt", "state_groundtruth.txt")
LEAST_SHARE = 0.5
"""The share of the comparable poses, and of the estimate's time, that must be compared."""
_WITHIN = f"within {MAX_TIME_DIFFERENCE} s"
ROS = {"error": "split", "axes": "world"}  # as PoseWithCovariance is documented
Place: TypeAlias = Path | ros.Topic


class RunFiles(NamedTuple):
    """The name of one trajectory, and the paths of its files, or topics of bags."""

    name: str
    estimate: Place
    covariance: Place
    truth: Place


_File: TypeAlias = tuple[Place, np.ndarray]
"""A path or topic, and the times in it."""


class _AtTimes(NamedTuple):
    """The content of a file at the times of the estimate; NaN where it holds nothing."""

    times: Float[np.ndarray, " m"]
    """The file's own times."""
    values: Float[np.ndarray, "n d d"]
    used: int
    """The number of its own times that are times of the estimate."""

    @property
    def there(self) -> Bool[np.ndarray, " n"]:
        return ~np.isnan(self.values[:, 0, 0])


class _RunLog(NamedTuple):
    """A run, pose by pose of its estimate."""

    run: RunFiles
    times: Float[np.ndarray, " n"]
    estimates: Float[np.ndarray, "n d d"]
    covariances: _AtTimes
    truths: _AtTimes
    said: dict[str, str]
    evaluated: EvaluatedPoses
    """The poses that have a part in the verdict, by the tracker's own record of its frames."""


def runs_of(
    source: Path, covariance: str | Path | None, truth: str | Path | None, estimate: str | None
) -> tuple[RunFiles, ...]:
    """The files of every run. Raises ValueError where one is not there, or two could be meant."""
    bags = [source] if ros.is_bag(source) else sorted(filter(ros.is_bag, source.glob("*")))
    texts = (*source.glob("*.txt"), *source.glob("*/*.txt"))
    if bags and not any(path.name in ESTIMATES for path in texts):
        if covariance is not None:
            raise ValueError(f"{source}: a bag has its own covariances; leave out --covariance")
        own, true = estimate or "", str(truth or "")
        told = [ros.chosen(bag, own, ros.WITH_COVARIANCE, "--estimate", true) for bag in bags]
        return tuple(RunFiles(x.parent.stem, x, x, _truth_of(true, x.parent, x.name)) for x in told)
    if estimate is not None:
        raise ValueError(f"{source}: --estimate is for {ros.BAG}, which this is not")
    if not source.is_dir():
        covariance = covariance or _own_covariances(source)
        for name, value in (("covariance", covariance), ("truth", truth)):
            if value is None:
                raise ValueError(
                    f"{source}: a trajectory needs a {name} file beside it (--{name} FILE); "
                    "arrays need a .npz or .csv file"
                )
        return (RunFiles(source.stem, source, Path(str(covariance)), _truth_of(str(truth))),)
    folders = sorted(x for x in source.iterdir() if x.is_dir() and x.name[0] != ".")
    if _only(source, ESTIMATES) is not None:
        if runs := [folder.name for folder in folders if _only(folder, ESTIMATES) is not None]:
            raise ValueError(
                f"{source} has a run and sub-folders with runs ({', '.join(runs[:3])}); expected "
                "one run, or one sub-folder per run"
            )
        return (_run(source, covariance, truth),)
    if covariance is not None:
        raise ValueError(f"{source}: each of several runs needs its own covariance.txt")
    if not folders:
        raise ValueError(f"{source} has neither {ESTIMATES[0]} nor sub-folders, one per run")
    return tuple(_run(folder, None, truth) for folder in folders)


def _own_covariances(estimate: Path) -> Path | None:
    """The file itself, where its lines have the covariances of their poses too."""
    return estimate if width(estimate) == WITH_COVARIANCE else None


def _truth_of(given: str, bag: Path | None = None, estimate: str = "") -> Place:
    """A file, or a topic: of the bag that is named with it, or else of the estimate's."""
    parts = ros.bag_and_topic(given) if given else None
    if parts is not None:
        return ros.chosen(*parts, ros.POSES, "--truth BAG:TOPIC")
    if bag is None or Path(given).is_file():
        return Path(given)
    return ros.chosen(bag, given, ros.POSES, "--truth", estimate)


def _run(folder: Path, covariance: str | Path | None, truth: str | Path | None) -> RunFiles:
    def found(given: str | Path | None, names: tuple[str, ...]) -> Path:
        path = _only(folder, names) if given is None else Path(given)
        if path is None:
            raise ValueError(f"{folder} has no {' or '.join(names)}")
        return path

    true = found(None, TRUTHS) if truth is None else _truth_of(str(truth))
    estimate = found(None, ESTIMATES)
    files = estimate, found(covariance or _own_covariances(estimate), COVARIANCES), true
    return RunFiles(folder.resolve().name, *files)


def _only(folder: Path, names: tuple[str, ...]) -> Path | None:
    """The one file of these names. Raises ValueError where there are two, maybe of two runs."""
    there = [folder / name for name in names if (folder / name).is_file()]
    if len(there) > 1:
        raise ValueError(f"{folder} has both {' and '.join(path.name for path in there)}; keep one")
    return there[0] if there else None


def evaluate_runs(
    source: Path, runs: tuple[RunFiles, ...], stated: dict[str, str], how: PoseOptions
) -> Evaluation:
    """The verdict on the runs of a source, in the convention that is stated, or said in the files.

    `how` are the options of `evaluate_poses`.
    """
    read = [_read(run) for run in runs]
    convention = _convention_of(read, stated)
    for one in read:
        if one.evaluated.map and convention.scale == "given" and how["align"] != "sim3":
            raise ValueError(
                f"{one.run.estimate}: its longest map is map {one.evaluated.map}, in a unit of its "
                "own; use --align sim3"
            )
    if len({one.estimates.shape[1:] for one in read}) > 1:
        raise ValueError(f"{source}: planar and spatial runs cannot be mixed")
    names = tuple(run.name for run in runs)
    truths = [np.where(x.evaluated.poses[:, None, None], x.truths.values, np.nan) for x in read]
    longest = max(read, key=lambda one: len(one.times))
    found = named(
        runs[0].estimate if len(runs) == 1 else source,
        lambda: evaluate_poses(
            _filled_up([one.estimates for one in read]),
            _filled_up([one.covariances.values for one in read]),
            _filled_up(truths),
            convention,
            times=longest.times,
            **how,
        ),
        names,
    )
    told = (
        *_left_out(read), *left_out([one.evaluated for one in read]),
        *_other_times(read, longest), *_other_body(runs[0]),
    )  # fmt: skip
    if not read[0].said and not stated:
        told += (f"the file does not state its convention; assumed: {convention}",)
    return replace(found, notes=(*found.notes, *told), run_names=names)


def _convention_of(read: list[_RunLog], stated: dict[str, str]) -> Convention:
    """The convention of all runs. Raises ValueError where their files say different ones."""
    for one in read:
        if one.said != read[0].said:
            raise ValueError(
                f"{one.run.covariance} states a different convention ({Convention(**one.said)}) "
                f"from {read[0].run.covariance} ({Convention(**read[0].said)})"
            )
    return stated_before(read[0].said, stated)


def _filled_up(runs: list[np.ndarray]) -> np.ndarray:
    """Stack all runs in one array, with NaN behind those that are shorter than the longest."""
    result = np.full((len(runs), max(map(len, runs)), *runs[0].shape[1:]), np.nan)
    for whole, run in zip(result, runs, strict=True):
        whole[: len(run)] = run
    return result


def stated_before(said: dict[str, str], stated: dict[str, str]) -> Convention:
    """The convention as stated, else as in the files; a stated error overrides their axes too."""
    if "error" in stated:
        said = {name: value for name, value in said.items() if name != "axes"}
    return Convention(**(said | stated))


def named(
    source: Place,
    evaluation: Callable[[], Evaluation],
    runs: Sequence[str] = (),
    steps: Sequence[str] = (),
) -> Evaluation:
    """Evaluate, with the names of file, runs and steps in every error."""
    try:
        return evaluation()
    except ValueError as error:
        told = str(error)
        for place, names in ((r"\brun (\d+)", runs), (r"\bstep (\d+)", steps)):
            if names:
                told = re.sub(place, lambda found, names=names: names[int(found[1])], told)
        raise ValueError(f"{source}: {told}") from None


def _left_out(read: list[_RunLog]) -> Iterator[str]:
    """A sentence for everything in the files that has no part in the verdict."""
    logged = sum(len(one.times) for one in read)
    kinds = ("covariance", [x.covariances for x in read]), ("truth", [x.truths for x in read])
    for what, found in kinds:
        if without := logged - sum(int(np.sum(x.there)) for x in found):
            yield f"{without} of {logged} poses have no {what} {_WITHIN}, and are left out"
    for what, found in kinds:
        held = sum(len(x.times) for x in found)
        if unused := held - sum(x.used for x in found):
            many = {"covariance": "covariances", "truth": "true poses"}[what]
            yield f"{unused} of {held} {many} are at no time of the estimate, and are left out"
    shortest, longest = (f(len(one.times) for one in read) for f in (min, max))
    if shortest < longest:
        yield f"runs have {shortest} to {longest} poses"


def _other_times(read: list[_RunLog], longest: _RunLog) -> Iterator[str]:
    """A remark where steps, which are counted, are not at the same times after the first pose."""

    def since(one: _RunLog, steps: int) -> np.ndarray:
        return one.times[:steps] - one.times[0]

    for one in read:
        steps = len(one.times)
        if np.abs(since(one, steps) - since(longest, steps)).max() > MAX_TIME_DIFFERENCE:
            yield (
                "steps are counted from the first pose of each run; their times differ between "
                f"runs, and are those of {longest.run.name}"
            )
            return


def _other_body(run: RunFiles) -> Iterator[str]:
    """That the topics say that they are poses of different frames."""
    own, true = ros.body_of(run.estimate), ros.body_of(run.truth)
    if own and true and own != true:
        yield f"the estimate is of {own} and the truth of {true}: what is between counts as error"


def _read(run: RunFiles) -> _RunLog:
    """Read one run, pose by pose of its estimate. Raises ValueError where few can be compared."""
    at, (times, estimates, P) = run.covariance, ros.read_poses(run.estimate)
    true_times, truths, _ = ros.read_poses(run.truth)
    if geometry_of(truths) is not geometry_of(estimates):
        raise ValueError(f"{run.truth}: estimate and truth must both be planar or both be spatial")
    if at == run.estimate:
        text = CovarianceText(times, P, MIXED if isinstance(at, Path) else ROS)
    else:
        text = read_covariances(Path(str(at)), geometry_of(estimates).tangent_dim)
    files = (run.estimate, times), (run.covariance, text.times), (run.truth, true_times)
    for path, told in files:
        _check_times(path, told)
    covariances = _at_times(files[0], files[1], text.covariances)
    true = _at_times(files[0], files[2], truths)
    those = evaluated_poses(run.estimate.parent, times, exactly_known(covariances.values))
    read = _RunLog(run, times, estimates, covariances, true, text.said, those)
    _check_share(read)
    return read


def _check_times(path: Place, times: Float[np.ndarray, " n"]) -> None:
    """Raise ValueError unless times are seconds, of one run, and of their own each."""
    check_seconds(str(path), times)
    back = np.flatnonzero(np.diff(times) < 0)
    if back.size:
        raise ValueError(
            f"{path}: times decrease from {times[back[0]]:.3f} to {times[back[0] + 1]:.3f} s; "
            "expected one run in temporal order"
        )
    different = len(np.unique(times))
    if different < LEAST_SHARE * len(times):
        raise ValueError(
            f"{path}: its {len(times)} poses have only {different} different times, perhaps "
            "printed with too few digits or never stamped; every pose needs its own time"
        )


def _at_times(ours: _File, theirs: _File, values: Float[np.ndarray, "m ..."]) -> _AtTimes:
    """The values at our times. Raises ValueError where there is none."""
    (path, times), (other, other_times) = ours, theirs
    at, of = associated(times, other_times)
    if not len(at):
        spans = " and ".join(f"{x.min():.3f}–{x.max():.3f} s" for x in (times, other_times))
        raise ValueError(f"{path} and {other} have no time stamps in common {_WITHIN}: {spans}")
    result = np.full((len(times), *values.shape[1:]), np.nan)
    nearest_last = np.argsort(-np.abs(times[at] - other_times[of]), kind="stable")
    result[at[nearest_last]] = values[of[nearest_last]]
    return _AtTimes(other_times, result, len(np.unique(of)))


def _check_share(read: _RunLog) -> None:
    """Raise ValueError where most of a run would not be compared."""
    others = (read.run.covariance, read.covariances), (read.run.truth, read.truths)
    there = read.covariances.there & read.truths.there
    fewest = min(len(x) for x in (read.times, read.covariances.times, read.truths.times))
    enough = np.sum(there) >= LEAST_SHARE * fewest
    if enough and _span(read.times[there]) >= LEAST_SHARE * _span(read.times):
        return
    path, worse = min(others, key=lambda other: int(np.sum(other[1].there)))
    after = np.clip(np.searchsorted(worse.times, read.times), 1, max(len(worse.times) - 1, 1))
    beside = worse.times[np.minimum([after - 1, after], len(worse.times) - 1)]
    away = float(np.median(np.abs(beside - read.times).min(axis=0)))
    raise ValueError(
        f"{read.run.estimate}: of its {_held(read.times)} only {np.sum(there)} can be compared: "
        f"{np.sum(read.covariances.there)} have a covariance {_WITHIN}, and "
        f"{np.sum(read.truths.there)} a truth. {path} has {_held(worse.times)}; the nearest one "
        f"is {away:.3g} s away (median). A verdict needs half the lines of the shortest file, "
        "covering half the duration of the estimate"
    )


def _held(times: Float[np.ndarray, " n"]) -> str:
    return f"{len(times)} times from {times[0]:.3f} to {times[-1]:.3f} s"


def _span(times: Float[np.ndarray, " n"]) -> float:
    return float(times[-1] - times[0]) if len(times) else 0.0


FRAMES = "frames.csv"


class FrameLog(NamedTuple):
    """The log of all frames of a video, docs/gauge.md."""

    times: Float[np.ndarray, " k"]
    lost: Bool[np.ndarray, " k"]
    maps: Int[np.ndarray, " k"]
    """The number of the map. Each has a unit of length of its own."""
    fixed: Bool[np.ndarray, " k"]
    """Whether the unit of the map is fixed; before that it changes with the frames."""


class EvaluatedPoses(NamedTuple):
    """A mask of the poses of a run that have a part in the verdict, and counts of the others."""

    poses: Bool[np.ndarray, " n"]
    map: int = 0
    """The map that is evaluated."""
    others: tuple[int, int, int] = (0, 0, 0)
    """The poses of other maps, those that are lost, and those from before the unit was fixed."""


def evaluated_poses(
    folder: Path, times: Float[np.ndarray, " n"], known: Bool[np.ndarray, " n"]
) -> EvaluatedPoses:
    """The poses at these times that the tracker's file in the folder leaves to be evaluated.

    They are of the longest map, without frames that are lost or whose unit is not fixed. A pose
    that is `known` exactly stays: it is where the map begins, and has a place in any unit. All
    poses where there is no such file. Raises ValueError where it is of other times, or nothing is
    left.
    """
    path = folder / FRAMES
    frames = read_frames(path)
    if frames is None:
        return EvaluatedPoses(np.ones(len(times), bool))
    order = np.argsort(frames.times, kind="stable")
    place = np.interp(times, frames.times[order], np.arange(len(order)))
    nearest = order[np.rint(place).astype(int)]
    away = np.abs(frames.times[nearest] - times)
    if away.max() > MAX_TIME_DIFFERENCE:
        raise ValueError(
            f"{path}: no frame is within {MAX_TIME_DIFFERENCE} s of the pose at "
            f"{times[np.argmax(away)]:.3f} s; it must list the frames of the trajectory beside it"
        )
    _, lost, maps, fixed = (x[nearest] for x in frames)
    usable = fixed & ~lost
    if not usable.any():
        raise ValueError(f"{path}: every frame with a pose is lost or has no fixed unit yet")
    number = int(np.argmax(np.bincount(maps[usable])))
    own = maps == number
    opening = own & ~lost & ~fixed & ~known
    others = int(np.sum(~own)), int(np.sum(own & lost)), int(np.sum(opening))
    return EvaluatedPoses(own & ~lost & ~opening, number, others)


def read_frames(path: Path) -> FrameLog | None:
    """Read the file of a tracker; None where there is none, or another one of its name.

    Raises ValueError, naming the line, for what a tracker does not write.
    """
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return None
    titles, *rows = [[word.strip() for word in line.split(",")] for line in lines] or [[]]
    if not {"time", "state", "map", "unit_fixed"} <= set(titles):
        return None
    table = [
        _frame(f"{path}, line {number}", dict(zip(titles, row, strict=False)))
        for number, row in enumerate(rows, start=2)
        if row != [""]
    ]
    if not table:
        raise ValueError(f"{path} has no frames")
    return FrameLog(*(np.array(column) for column in zip(*table, strict=True)))


def _frame(place: str, told: dict[str, str]) -> tuple[float, bool, int, bool]:
    """The numbers of a frame, in the order of `FrameLog`. Raises ValueError for what is none."""
    try:
        time, number, fixed = float(told["time"]), int(told["map"]), told["unit_fixed"]
        if np.isfinite(time) and 0 <= number <= 1_000_000 and fixed in ("0", "1"):
            return time, told["state"] == "lost", number, fixed == "1"
    except (ValueError, KeyError):
        pass
    raise ValueError(
        f"{place}: expected a finite time, a state, the number of a map, and unit_fixed 0 or 1"
    )


def left_out(runs: Sequence[EvaluatedPoses]) -> Iterator[str]:
    """A sentence for every reason why poses of the runs are not evaluated."""
    logged = sum(len(one.poses) for one in runs)
    which = f"map {runs[0].map}, the longest," if len(runs) == 1 else "the longest map of each run"
    reasons = (
        (f"{which} is evaluated: ", "of other maps, each with its own unit"),
        ("", "of frames that are lost"),
        ("", "from before the unit of their map was fixed"),
    )
    counts = np.sum([one.others for one in runs], axis=0)
    for (first, reason), count in zip(reasons, counts, strict=True):
        if count:
            yield f"{first}{count} of {logged} poses are {reason} and left out"
