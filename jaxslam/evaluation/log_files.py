"""The verdict on logs in files: arrays in npz or CSV; trajectories, covariances, truths; bags."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from jaxslam._runtime.lookup import lookup
from jaxslam.evaluation.alignment import MAX_TIME_DIFFERENCE
from jaxslam.evaluation.causes import explained, suspect
from jaxslam.evaluation.clock import Offset
from jaxslam.evaluation.convention import CHOICES, Convention
from jaxslam.evaluation.inputs import ARRAYS, STEP_FIRST, by_runs, of_sigmas, read_csv
from jaxslam.evaluation.pairing import (
    Place,
    RunFiles,
    RunLog,
    RunLogs,
    paired,
    read_run,
    with_other,
)
from jaxslam.evaluation.poses import evaluate_poses
from jaxslam.evaluation.result import Evaluation, advice, described, evaluate, evaluate_nees
from jaxslam.evaluation.sanity_checks import Mistake
from jaxslam.io import ros
from jaxslam.io.text import read_table

_CONTENTS = (
    "errors and covariances, innovations and covariances, or estimates, covariances and truths "
    "(or σ instead of covariances), or nees or nis with dof"
)
_ALONE = ("nees", "nis")
_KEYS = (
    "errors", "innovations", "covariances", "sigmas", "estimates", "truths", "nees", "nis", "dof",
    "times", "names", *CHOICES,
)  # fmt: skip
Options = dict[str, Any]
"""The options for evaluating poses, see `evaluate_poses`."""
Names = Sequence[str]
Runs = tuple[RunFiles, ...]


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
    time_offset: float | str = 0.0,
    against: str | Path | None = None,
) -> Evaluation:
    """The verdict on what a file or a folder holds.

    `source` is a file of arrays (npz, mat), a table of `run, step, errors, upper triangle` lines, a
    trajectory of any format that `jaxslam.io.logs` knows, with its `covariance`, unless it has one
    itself, and `truth`, or a folder. A folder has a run of `estimate.txt`, `covariance.txt` and
    `truth.txt`, or one per sub-folder, or trajectories with their covariances beside one truth, or
    ROS bags. The topics of a bag are named by `estimate` and `truth` where several fit. The stamps
    of the estimate are late by the `time_offset`, s, or by what its rotations say (`auto`). In
    place of a truth it may be compared `against` another log of the same run, whose covariances are
    added as if the errors of both were independent. Where
    the tracker's `frames.csv` is beside a trajectory, its longest map is evaluated, without frames
    that are lost or whose unit was not fixed yet. What is `stated` of the convention (`error`,
    `axes`, `order`,
    `scale`) comes before what the files say. For the alignment of poses, the axes used and the
    σ of the truth see `evaluate_poses`. With `nis` errors are innovations. The
    `innovations` of the same filter, in an npz or CSV file, say what to turn (`advice`), and so do
    those alone. Raises ValueError, naming the file.
    """
    if innovations is not None and nis:
        raise ValueError("give --nis or --innovations FILE, not both")
    (source, topic), stated = ros.bag_and_topic(source) or (Path(source), ""), dict(stated or {})
    estimate = estimate or topic or None
    how = {"align": align, "axes_used": axes_used, "truth_sigma": truth_sigma}
    if not source.exists():
        raise ValueError(f"{source}: no such file or folder")
    if against is not None and truth is not None:
        raise ValueError("give --truth or --against, not both")
    truth = against if truth is None else truth
    beside = {"covariance": covariance, "truth": truth, "estimate": estimate}
    if source.suffix in ARRAYS or (source.is_file() and _is_table(source, beside)):
        if given := [name for name, value in beside.items() if value is not None]:
            raise ValueError(f"{source}: --{given[0]} goes with a trajectory, not with arrays")
        found = _of_arrays(source, stated, how, nis)
    elif nis:
        raise ValueError(f"{source}: innovations must be in an npz or CSV file")
    else:
        runs = runs_of(source, covariance, truth, estimate)
        found = _of_runs(source, runs, stated, how, time_offset, against is not None)
    if innovations is None:
        return found
    of_innovations = evaluate_log(innovations, nis=True)
    told = f"{of_innovations.headline.partition(':')[0]} (of innovations)"
    return described(found, notes=(*found.notes, f"{told}; {advice(of_innovations, found)}"))


def _of_arrays(source: Path, stated: dict[str, str], how: Options, nis: bool) -> Evaluation:
    read = ARRAYS.get(source.suffix)
    arrays, runs, steps = (read(source), (), ()) if read else read_csv(source)
    found = named(source, lambda: _evaluate_arrays(by_runs(arrays), stated, how, nis), runs, steps)
    told = (advice(found),) if found.quantity == "NIS" and found.names else ()
    return described(found, run_names=runs, notes=(*found.notes, *told))


def _is_table(source: Path, beside: Mapping[str, object]) -> bool:
    """Whether a file is a table of errors: one without a truth beside it, or with such titles."""
    if ros.is_bag(source) or any(value is not None for value in beside.values()):
        return False
    table = source.suffix == ".csv"
    titles = () if table else read_table(source, "log", "errors", "numbers").titles
    return table or (bool(titles) and titles[0].lower() in ("run", *STEP_FIRST[:2]))


def _evaluate_arrays(
    arrays: dict[str, np.ndarray], stated: dict[str, str], how: Options, nis: bool
) -> Evaluation:
    """The verdict on errors, innovations or poses, by the names of the arrays."""
    for name in arrays:
        lookup("array", name, dict.fromkeys(_KEYS))
    held = [name for name in (*_ALONE, "errors", "innovations", "estimates") if name in arrays]
    if "sigmas" in arrays and "covariances" not in arrays:
        arrays = {**arrays, "covariances": of_sigmas(arrays["sigmas"])}
    of_poses = ["truths"] if held == ["estimates"] else []
    needed = {"dof"} if held and held[0] in _ALONE else {"covariances", *of_poses}
    if len(held) != 1 or not needed <= arrays.keys():
        raise ValueError(f"contains {', '.join(arrays)}; expected {_CONTENTS}")
    given, times = arrays[held[0]], arrays.get("times")
    if of_poses:
        said = {name: str(*np.ravel(arrays[name])[:1]) for name in CHOICES if name in arrays}
        P, truths, convention = arrays["covariances"], arrays["truths"], stated_before(said, stated)
        return evaluate_poses(given, P, truths, convention, times=times, **how)
    if stated or how["align"] != "none" or how["axes_used"] or how["truth_sigma"] is not None:
        raise ValueError(
            "a convention, an alignment, axes used and σ of the truth apply to poses, but the "
            "file has errors; give estimates, covariances and truths instead"
        )
    quantity = "NIS" if nis or held[0] in ("nis", "innovations") else "NEES"
    if held[0] in _ALONE:
        return evaluate_nees(given, arrays["dof"], times=times, quantity=quantity)
    names = [str(name) for name in np.ravel(arrays.get("names", ()))]
    return evaluate(given, arrays["covariances"], times=times, names=names, quantity=quantity)


ESTIMATES = ("estimate.txt", "trajectory.txt", "state_estimate.txt", "traj_estimate.txt")
COVARIANCES = ("covariance.txt", "state_deviation.txt")
TRUTHS = ("truth.txt", "groundtruth.txt", "state_groundtruth.txt", "reference.txt", "ref.txt")
TEXTS = (".txt", ".csv", ".tum", ".pos", ".smfeval", ".dat", ".g2o")
"""Endings of a file of these names; what it is says its content."""


def runs_of(
    source: Path, covariance: str | Path | None, truth: str | Path | None, estimate: str | None
) -> Runs:
    """The files of every run. Raises ValueError where one is not there, or two could be meant."""
    covariance = None if covariance is None else Path(covariance)
    bags = [source] if ros.is_bag(source) else sorted(filter(ros.is_bag, source.glob("*")))
    folders = sorted(x for x in source.glob("*/") if x.name[0] != ".")
    if bags and not any(_only(folder, ESTIMATES) for folder in (source, *folders)):
        if covariance is not None:
            raise ValueError(f"{source}: a bag has its own covariances; leave out --covariance")
        own, true = estimate or "", str(truth or "")
        told = [ros.chosen(bag, own, ros.WITH_COVARIANCE, "--estimate", true) for bag in bags]
        return tuple(
            RunFiles(x.parent.stem, x, None, _truth_of(true, x.parent, x.name)) for x in told
        )
    if estimate is not None:
        raise ValueError(f"{source}: --estimate is for {ros.BAG}, which this is not")
    if not source.is_dir():
        if truth is None:
            raise ValueError(
                f"{source}: a trajectory needs a truth file (--truth FILE) and, unless its own "
                "lines hold them, one of covariances (--covariance FILE); arrays need a .npz or "
                ".csv file"
            )
        of_folder = source.stem in (Path(name).stem for name in ESTIMATES)
        P = covariance or (_only(source.parent, COVARIANCES) if of_folder else None)
        return (RunFiles(source.stem, source, P, _truth_of(str(truth))),)
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
        return _beside_one_truth(source, truth)
    return tuple(_run(folder, None, truth) for folder in folders)


def _beside_one_truth(source: Path, truth: str | Path | None) -> Runs:
    """Every other trajectory of a folder as a run, with its covariances, against one truth."""
    true = _only(source, TRUTHS) if truth is None else Path(truth)
    files = sorted(x for x in source.glob("*") if x.suffix in TEXTS and x.is_file() and x != true)
    if true is None or not files or _only(source, COVARIANCES) is not None:
        raise ValueError(
            f"{source} has neither {ESTIMATES[0]} nor sub-folders, one per run, nor trajectories "
            f"beside one {TRUTHS[0]}"
        )
    return tuple(RunFiles(path.stem, path, None, _truth_of(str(true))) for path in files)


def _truth_of(given: str, bag: Path | None = None, estimate: str = "") -> Place:
    """A file, or a topic: of the bag that is named with it, or else of the estimate's."""
    parts = ros.bag_and_topic(given) if given else None
    if parts is not None:
        return ros.chosen(*parts, ros.POSES, "--truth BAG:TOPIC")
    if bag is None or Path(given).is_file():
        return Path(given)
    return ros.chosen(bag, given, ros.POSES, "--truth", estimate)


def _run(folder: Path, covariance: Path | None, truth: str | Path | None) -> RunFiles:
    def found(names: tuple[str, ...]) -> Path:
        path = _only(folder, names)
        if path is None:
            raise ValueError(f"{folder} has no {' or '.join(names)}")
        return path

    true = found(TRUTHS) if truth is None else _truth_of(str(truth))
    P = covariance or _only(folder, COVARIANCES)
    return RunFiles(folder.resolve().name, found(ESTIMATES), P, true)


def _only(folder: Path, names: tuple[str, ...]) -> Path | None:
    """The one file of these names, of any ending of a text, `stamped_` or not. Raises ValueError
    where there are two, maybe of two runs."""
    stems = [x for name in names for x in (Path(name).stem, f"stamped_{Path(name).stem}")]
    files = (x for x in folder.glob("*") if x.stem in stems and x.suffix in TEXTS and x.is_file())
    there = sorted(files, key=lambda path: (stems.index(path.stem), path.suffix))
    if len(there) > 1:
        raise ValueError(f"{folder} has both {' and '.join(path.name for path in there)}; keep one")
    return there[0] if there else None


def _of_runs(
    source: Path,
    runs: Runs,
    stated: dict[str, str],
    how: Options,
    time_offset: float | str,
    against: bool,
) -> Evaluation:
    """The verdict on the runs of a source, in the convention that is stated, or said in the files.

    `how` are the options of `evaluate_poses`; for the others see `evaluate_log`.
    """
    logs, names = [read_run(run) for run in runs], tuple(run.name for run in runs)
    convention, told = _convention_of(logs, stated), []
    if not all(one.oriented for one in logs) and not how["axes_used"]:
        how = Options(how, axes_used=("x", "y", "z"))
        told = ["without orientations: positions alone are compared (--axes-used x,y,z)"]

    def at_offset(offset: float | str) -> list[RunLog]:
        read = [paired(one, offset) for one in logs]
        return [with_other(one, convention) for one in read] if against else read

    def compared(read: list[RunLog]) -> Evaluation:
        times = max((one.times for one in read), key=len)
        arrays = zip(*((one.estimates, one.covariances, one.truths) for one in read), strict=True)
        return evaluate_poses(*map(_filled_up, arrays), convention, times=times, **how)

    read = at_offset(time_offset)
    for one in read:
        if one.map and convention.scale == "given" and how["align"] != "sim3":
            raise ValueError(
                f"{one.logs.files.estimate}: its longest map is map {one.map}, in a unit of its "
                "own; use --align sim3"
            )
    if len({one.estimates.shape[1:] for one in read}) > 1:
        raise ValueError(f"{source}: planar and spatial runs cannot be mixed")
    place = runs[0].estimate if len(runs) == 1 else source
    found = named(place, lambda: compared(read), names)
    wrong, automatic = suspect(found), time_offset == "auto"
    late = _offset(logs) if wrong or automatic else None
    if wrong and late is not None:
        with suppress(ValueError):  # an offset at which few poses have a truth is none of clocks
            found = _in_time(found, compared(at_offset(late.seconds)), late)
    if automatic or (wrong and late is not None and late.found):
        found = described(found, time_offset=late)
    told += _remarks(read)
    if (logs[0].estimate.assumed or not logs[0].estimate.said) and not stated:
        told.append(f"the file does not state its convention; assumed: {convention}")
    return described(found, notes=(*found.notes, *told), run_names=names)


def _in_time(found: Evaluation, fixed: Evaluation, late: Offset) -> Evaluation:
    """The evaluation with the offset of the clocks as the cause, where NEES falls without it; and,
    where that is not certain, nothing else is wrong."""
    before, after = (float(np.mean(x.nees[x.logged])) for x in (found, fixed))
    certain = bool(late.found and after < before / 1.2)  # so a NEES falls without its cause
    if not certain and (after >= before or not explained(fixed)):
        return found
    error = float(f"{1e3 * late.sigma:.1g}")
    clock = Mistake(
        f"the clocks of estimate and truth {'' if certain else 'may '}differ",
        f"the stamps of the estimate are {1e3 * late.seconds:.1f} ± {error:g} ms late, by its "
        f"rotations: with --time-offset {late.seconds:.4f} (or auto) NEES is {after:.4g} instead "
        f"of {before:.4g}",
        after,
        certain,
    )
    return described(found, causes=(clock, *fixed.causes))


def _offset(logs: list[RunLogs]) -> Offset | None:
    """The median offset of the runs' clocks, by their σ; None where rotations do not tell it."""
    told = (one.offset for one in logs[:10])  # more would say no more
    offsets = [x for x in told if x is not None and np.isfinite(x.sigma)]
    if not offsets:
        return None
    late, sigma = np.array(sorted(offsets)).T
    share = np.cumsum(weight := 1 / np.maximum(sigma, 1e-9))
    middle = late[np.searchsorted(share, share[-1] / 2)]
    scatter = max(float(np.median(np.abs(late - middle) * weight)) / 0.67, 1.0)  # of σ, where right
    return Offset(float(middle), scatter * float(np.sum(weight**2) ** -0.5))


def _remarks(read: list[RunLog]) -> Iterator[str]:
    """The remarks of all runs, with their counts added where they differ in those alone."""
    for what in dict.fromkeys(what for one in read for what in one.left_out):
        counts = np.array([one.left_out.get(what, (0, len(one.times))) for one in read]).sum(axis=0)
        yield f"{counts[0]} of {counts[1]} {what}, and are left out"
    said = dict.fromkeys(note for one in read for note in one.notes)
    yield from said if len(said) <= 3 else [*list(said)[:2], f"and {len(said) - 2} more such"]
    shortest, longest = (f(len(one.times) for one in read) for f in (min, max))
    if shortest < longest:
        yield f"runs have {shortest} to {longest} poses"
    first = max(read, key=lambda one: len(one.times))
    later = (one.times - first.times[: len(one.times)] for one in read)
    if any(np.abs(x - x[0]).max() > MAX_TIME_DIFFERENCE for x in later):
        yield (
            "steps are counted from the first pose of each run; their times differ between runs, "
            f"and are those of {first.logs.files.name}"
        )


def _convention_of(logs: list[RunLogs], stated: dict[str, str]) -> Convention:
    """The convention of all runs. Raises ValueError where their files say different ones."""
    said = {one.files.of_covariances: one.estimate.said for one in logs}
    (first, of_first), *others = said.items()
    for place, own in others:
        if Convention(**own) != Convention(**of_first):
            raise ValueError(
                f"{place} states a different convention ({Convention(**own)}) from {first} "
                f"({Convention(**of_first)})"
            )
    return stated_before(of_first, stated)


def _filled_up(runs: Sequence[np.ndarray]) -> np.ndarray:
    """Stack all runs in one array, with NaN behind those that are shorter than the longest."""
    result = np.full((len(runs), max(map(len, runs)), *runs[0].shape[1:]), np.nan)
    for whole, run in zip(result, runs, strict=True):
        whole[: len(run)] = run
    return result


def stated_before(said: Mapping[str, str], stated: dict[str, str]) -> Convention:
    """The convention as stated, else as in the files; a stated error overrides their axes too."""
    if "error" in stated:
        said = {name: value for name, value in said.items() if name != "axes"}
    return Convention(**{**said, **stated})


def named(
    source: Place, evaluation: Callable[[], Evaluation], runs: Names = (), steps: Names = ()
) -> Evaluation:
    """Evaluate, with the names of file, runs and steps in every error."""

    def renamed(told: str) -> str:
        for place, names in ((r"\brun (\d+)", runs), (r"\bstep (\d+)", steps)):
            if names:
                told = re.sub(place, lambda found, names=names: names[int(found[1])], told)
        return told

    try:
        found = evaluation()
    except ValueError as error:
        raise ValueError(f"{source}: {renamed(str(error))}") from None
    return described(found, causes=tuple(x._replace(told=renamed(x.told)) for x in found.causes))
