"""Bad input, many times: everything that reads is given files that something happened to.

`PYTHONPATH=tests python tests/fuzz/fuzz.py --cases 100000`; `--first N --cases 1` repeats case N.
Case i draws from (seed, i) alone. A case is good if it ends in a ValueError of one line, or in a
result whose numbers are finite; a pickle in the data must not be run, and a command leaves whole
files or none.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import itertools
import json
import math
import os
import resource
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import tyro
import videos
import whole_files as given
from bags import KINDS
from logs import LOGS
from mutations import MARK, mutate_folder, mutated_array, mutated_text

import jaxslam
from jaxslam.cli import main as command
from jaxslam.consistency import summarise
from jaxslam.evaluation import (
    CHOICES,
    Convention,
    Evaluation,
    evaluate,
    evaluate_log,
    evaluate_poses,
    read_covariances,
)
from jaxslam.io.lens_files import read_calibration
from jaxslam.io.opening import open_source
from jaxslam.io.tum import read_tum
from jaxslam.simulation.scenario import parse_override
from jaxslam.simulation.trajectories import _sampled
from jaxslam.tracking.persistence import read_record
from jaxslam.tracking.target import read_target

MEMORY = 8 << 30
"""Bytes; what wants more than that for a few small files is a finding."""
LONGEST = 2000
"""Letters of an error that still is a line."""


class Target(NamedTuple):
    """Something that reads: whole files for it, and how it is asked to read them."""

    write: Callable[[Path], object]
    read: Callable[[Path, np.random.Generator], Any]
    weight: float = 1.0


class Finding(NamedTuple):
    """A case that did not end as it must."""

    case: int
    target: str
    what: str


def read_poses(folder: Path, draw: np.random.Generator) -> Any:
    arrays: dict[str, Any] = given.pose_arrays()
    name = list(arrays)[int(draw.integers(3))]
    arrays[name] = mutated_array(draw, arrays[name])
    choices = {key: values[int(draw.integers(len(values)))] for key, values in CHOICES.items()}
    align = ("none", "se3", "sim3")[int(draw.integers(3))]
    try:
        convention = Convention(**choices)
    except ValueError:
        convention = Convention()
    return evaluate_poses(
        arrays["estimates"], arrays["covariances"], arrays["truths"], convention, align=align
    )


def read_errors(folder: Path, draw: np.random.Generator) -> Any:
    errors, P = given.errors_and_covariances()
    if draw.random() < 0.5:
        errors = mutated_array(draw, errors)
    else:
        P = mutated_array(draw, P)
    return evaluate(errors, P, quantity=("NEES", "NIS")[int(draw.integers(2))])


def read_trajectories(folder: Path, draw: np.random.Generator) -> Any:
    align = ("none", "se3", "sim3")[int(draw.integers(3))]
    return evaluate_log(folder, align=align)


def read_source(name: str = "") -> Callable[[Path, np.random.Generator], Any]:
    def read(folder: Path, draw: np.random.Generator) -> Any:
        source = open_source(folder / name)
        frames = [(frame.time, frame.image.shape) for frame in source]
        assert all(a[0] < b[0] for a, b in itertools.pairwise(frames)), "times"
        return source.calibration, source.times, source.reference, frames

    return read


OVERRIDES = ("pixel_sigma=0.5", "velocity=[1,2,3]", "steps=7", "calibration=white", "rate=30")
NAMES = (
    "world",
    "robocentric+oc",
    "scale_gauge+scene50+mixture3+rest8",
    "recommended+submaps",
    "nothing",
)


def read_override(folder: Path, draw: np.random.Generator) -> Any:
    text = mutated_text(draw, OVERRIDES[int(draw.integers(len(OVERRIDES)))]).strip("\n")
    return jaxslam.scenario("circle", dict([parse_override(text)]))


def read_filter(folder: Path, draw: np.random.Generator) -> Any:
    name = NAMES[int(draw.integers(len(NAMES)))].replace("+", " ")
    name = mutated_text(draw, name).strip("\n").replace(" ", "+")
    return list(jaxslam.make_filters("matched", name, "inverse_scaling"))


def read_pieces(folder: Path, draw: np.random.Generator) -> Any:
    makers: list[tuple[Callable[..., Any], list[Any]]] = [
        (jaxslam.Camera, [[650.0], [320.0]]),
        (jaxslam.Camera, [[650.0, 650.0], [320.0, 240.0], [0.0] * 5]),
        (lambda sigma: jaxslam.Pinhole(jaxslam.Camera([650.0], [320.0]), sigma), [0.3]),
        (jaxslam.ConstantVelocity, [[0.1] * 3, [1.0, 0.0, 0.0], [0.1] * 3]),
        (jaxslam.Odometry, [[0.1] * 6]),
        (jaxslam.InverseDepth, [0.5, 0.25]),
        (jaxslam.RangeBearing, [[0.1, 0.2]]),
    ]
    make, told = makers[int(draw.integers(len(makers)))]
    i = int(draw.integers(len(told)))
    told = [*told[:i], mutated_array(draw, np.asarray(told[i])), *told[i + 1 :]]
    made = make(*told)
    return made.geometry if isinstance(made, jaxslam.AbstractMotion) else None


def read_sampled(path: Path) -> Any:
    return _sampled.__wrapped__(path, 20.0, 5, ())


def read_header(path: Path) -> Any:
    return read_record(path)[0]


def read_tracker(path: Path) -> Any:
    return jaxslam.Tracker.load(path).settings


def read_resumed(folder: Path, draw: np.random.Generator) -> Any:
    return summarise(given.small_study(folder))


BAD_ARGUMENTS = (
    ["consistency", "--runs"], ["consistency", "--seed"],
    ["consistency", "--dtype"], ["consistency", "--scenario"], ["consistency", "--landmarks"],
    ["consistency", "--filters"], ["consistency", "--calibration"], ["consistency", "--set"],
    ["track", "--filter"], ["track", "--frames"], ["track", "--scale"], ["track", "--every"],
    ["track", "--landmarks"], ["track", "--calibration-treatment"], ["track"], ["calibrate"],
    ["evaluate"], ["triangulate", "--depth"], ["triangulate", "--particles"],
    ["triangulate", "--baseline"], ["evaluate", "/dev/null", "--error"], ["nothing"], [],
)  # fmt: skip
REFUSED = ("nan", "-1", "abc", "−1", "[]", "../x", "-7.5", "é", "\x00x", "9" * 400, "--", "'")


def run_wrong_command(folder: Path, draw: np.random.Generator) -> Any:
    words = BAD_ARGUMENTS[int(draw.integers(len(BAD_ARGUMENTS)))]
    value = REFUSED[int(draw.integers(len(REFUSED)))]
    status, _ = _commanded([*words, value, "--out", str(folder / "out")])
    assert status == 2, f"{words} {value} ended with {status}"


def run_evaluate(folder: Path, draw: np.random.Generator) -> Any:
    out = folder / "out"
    status, error = _commanded(["evaluate", str(_only(folder)), "--out", str(out)])
    if status:
        assert status == 2, f"ended with {status}"
        assert error.count("\n") == 1, error
        assert error.startswith("jaxslam: "), error
        return None
    assert sorted(path.name for path in out.iterdir()) == ["evaluation.json", "evaluation.png"]
    return json.loads((out / "evaluation.json").read_text(), parse_constant=_no_number)


def _only(folder: Path) -> Path:
    files = [path for path in folder.iterdir() if path.name != "out"]
    return files[0] if len(files) == 1 else folder


def _no_number(word: str) -> Any:
    raise AssertionError(f"{word} in a JSON file")


def _commanded(arguments: list[str]) -> tuple[int, str]:
    """A command's exit status and what it says to standard error."""
    out, error = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
            command(arguments)
    except SystemExit as stop:
        return int(stop.code or 0), error.getvalue()
    return 0, error.getvalue()


def _file(name: str, read: Callable[[Path], Any]) -> Callable[[Path, np.random.Generator], Any]:
    return lambda folder, draw: read(folder / name)


TARGETS: dict[str, Target] = {
    "evaluate": Target(given.nothing, read_errors),
    "evaluate_poses": Target(given.nothing, read_poses),
    "evaluate_log folder": Target(given.write_run, read_trajectories),
    **{f"evaluate_log {name}": Target(log.write, log.evaluated, 0.3) for name, log in LOGS.items()},
    "jaxslam evaluate": Target(LOGS["npz of errors"].write, run_evaluate, 0.05),
    "jaxslam evaluate folder": Target(given.write_run, run_evaluate, 0.05),
    "jaxslam, wrong": Target(given.nothing, run_wrong_command, 0.3),
    "read_covariances": Target(given.write_run, _file("run0/covariance.txt", read_covariances)),
    "read_tum": Target(given.write_trajectory, _file("t.txt", read_tum)),
    "sampled": Target(given.write_trajectory, _file("t.txt", read_sampled)),
    "scenario": Target(given.write_scenario, _file("s.toml", jaxslam.scenario)),
    "override": Target(given.nothing, read_override),
    "make_filters": Target(given.nothing, read_filter),
    "pieces": Target(given.nothing, read_pieces),
    "read_calibration": Target(given.write_camera, _file("camera.json", read_calibration)),
    "read_target": Target(given.write_target, _file("target.json", read_target)),
    "open_source timestamps": Target(videos.timestamped, read_source()),
    "open_source tum": Target(videos.tum_rgbd, read_source("rgbd_dataset_freiburg2_desk")),
    "open_source euroc": Target(videos.euroc, read_source("MH_01_easy")),
    "open_source kitti": Target(videos.kitti, read_source("sequences/06")),
    "open_source 7scenes": Target(videos.seven_scenes, read_source("seq-01")),
    "open_source pictures": Target(videos.plain, read_source()),
    "open_source film": Target(given.write_film, read_source("film.mp4"), 0.5),
    **{f"open_source {name}": Target(videos.bag(name), read_source(name)) for name in KINDS},
    "read_record": Target(given.write_record_of_two, _file("tracker.npz", read_header)),
    "Tracker.load": Target(given.write_tracker, _file("tracker.npz", read_tracker), 0.05),
    "resume": Target(lambda folder: given.small_study(folder) and None, read_resumed, 0.2),
}


def problem(target: Target, folder: Path, trap: Path, draw: np.random.Generator) -> str:
    """What is wrong with how a case ends; given.nothing if it ends as it must."""
    try:
        wrong = _not_finite(target.read(folder, draw))
    except ValueError as error:
        text = str(error)
        clear = text and "\n" not in text and len(text) <= LONGEST
        wrong = "" if clear else f"not one clear line: {text[:300]!r}"
    except (Exception, SystemExit):
        wrong = traceback.format_exc(limit=-6)
    if trap.exists() and trap.read_text() == MARK:
        wrong = "a pickle in the data was run"
    return wrong or _left_over(folder)


def _left_over(folder: Path) -> str:
    """A temporary file is half of one."""
    halves = [path.name for path in folder.rglob(f".{os.getpid()}.*")]
    return f"left behind: {', '.join(halves)}" if halves else ""


def _not_finite(result: Any) -> str:
    if isinstance(result, Evaluation):  # an infinite NEES is one of a run that diverged
        json.dumps(result.asdict(), allow_nan=False)
        assert str(result)
        return "" if result.logged.any(axis=1).all() else "a run without a NEES"
    bad = next((place for place, x in _numbers(result, "result") if not np.isfinite(x).all()), None)
    return f"{bad} is not finite" if bad else ""


def _numbers(x: Any, place: str) -> Iterator[tuple[str, np.ndarray]]:
    """All floating-point numbers in a result, with where they are."""
    if isinstance(x, float):
        yield place, np.asarray(x)
    elif isinstance(x, np.ndarray | jax.Array):
        if np.asarray(x).dtype.kind == "f":
            yield place, np.asarray(x)
    elif isinstance(x, dict):
        for key, value in x.items():
            yield from _numbers(value, f"{place}[{key!r}]")
    elif dataclasses.is_dataclass(x) and not isinstance(x, type):
        for field in dataclasses.fields(x):
            yield from _numbers(getattr(x, field.name), f"{place}.{field.name}")
    elif isinstance(x, list | tuple):
        for i, value in enumerate(x):
            yield from _numbers(value, f"{place}[{i}]")


class Fuzz:
    """Whole files, written once, and cases of what can happen to them."""

    def __init__(self, folder: Path, seed: int = 0, only: str = "") -> None:
        self.folder, self.seed = folder, seed
        self.targets = {name: t for name, t in TARGETS.items() if only in name}
        if not self.targets:
            raise ValueError(f"no target is called {only!r}; known: {', '.join(TARGETS)}")
        weights = np.array([target.weight for target in self.targets.values()])
        self.chances = weights / weights.sum()

    def case(self, index: int) -> Finding | None:
        """Run one case; what it found."""
        draw = np.random.default_rng([self.seed, index])
        name = str(draw.choice(list(self.targets), p=self.chances))
        whole = self.folder / "whole" / name.replace(" ", "-")
        if not whole.exists():
            whole.mkdir(parents=True)
            self.targets[name].write(whole)
        place, trap = self.folder / "case", self.folder / "trap"
        shutil.rmtree(place, ignore_errors=True)
        shutil.copytree(whole, place)
        mutate_folder(draw, place, trap)
        with warnings.catch_warnings(), jax.enable_x64(True):
            warnings.simplefilter("ignore", UserWarning)
            warnings.simplefilter("error", RuntimeWarning)
            what = problem(self.targets[name], place, trap, draw)
        return Finding(index, name, what) if what else None


@dataclasses.dataclass(frozen=True)
class Options:
    """Give everything that reads bad input, and say what did not end as it must."""

    cases: int = 1000
    first: int = 0
    """Number of the first case."""
    seed: int = 0
    only: str = ""
    """A part of the names of targets."""
    most: int = 20
    """Findings of a target that are shown."""


def main(options: Options) -> int:
    """Run the cases; the number of findings."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    start, found = time.perf_counter(), Counter()
    with tempfile.TemporaryDirectory() as folder:
        fuzz = Fuzz(Path(folder), options.seed, options.only)
        for index in range(options.first, options.first + options.cases):
            finding = fuzz.case(index)
            if finding:
                found[finding.target] += 1
                if found[finding.target] <= options.most:
                    print(f"case {index}, {finding.target}: {finding.what}", flush=True)
    seconds = time.perf_counter() - start
    print(f"{options.cases} cases in {seconds:.0f} s, {math.fsum(found.values()):.0f} findings")
    return sum(found.values())


if __name__ == "__main__":
    sys.exit(min(main(tyro.cli(Options)), 1))
