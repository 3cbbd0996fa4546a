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
import os
import resource
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import jax
import numpy as np
import recordings
import tyro
import videos
from bags import KINDS
from logs import LOGS, drawn, logged, write_runs
from mutations import MARK, mutate_folder, mutated_array, mutated_text, one_of
from pictures import HEIGHT, WIDTH, picture

import jaxslam
from jaxslam.cli import main as command
from jaxslam.consistency import FolderStore
from jaxslam.evaluation import (
    CHOICES,
    Convention,
    Evaluation,
    evaluate,
    evaluate_log,
    evaluate_poses,
)  # fmt: skip
from jaxslam.io.calibration import write_calibration
from jaxslam.io.lens_files import read_calibration
from jaxslam.io.opening import open_source
from jaxslam.io.tum import read_tum
from jaxslam.simulation.scenario import parse_override
from jaxslam.tracking.persistence import read_record, write_record
from jaxslam.tracking.synthetic import synthetic_source
from jaxslam.tracking.target import read_target

MEMORY = 8 << 30
"""Bytes; what wants more than that for a few small files is a finding."""
LONGEST = 2000
"""Letters of an error that still is a line."""
Draw = np.random.Generator
ALIGN = "none", "se3", "sim3"


class Target(NamedTuple):
    """Something that reads: whole files for it, and how it is asked to read them."""

    write: Callable[[Path], object]
    read: Callable[[Path, Draw], Any]
    weight: float = 1.0


# --- whole files ----------------------------------------------------------------------------------


def nothing(folder: Path) -> None:
    """No files."""


def write_run(folder: Path) -> None:
    write_runs(folder, *logged(Convention("right"), runs=2, steps=5), Convention("right"))


def write_scenario(folder: Path) -> None:
    (folder / "s.toml").write_text(
        'base = "circle"\nsteps = 5\npixel_sigma = 0.5\nvelocity = [0.0, 1.2, 0.3]\n'
        'calibration = "white"\nfirst_pixels = [[20.0, 620.0]]\nlandmarks = 12\n'
    )


def write_target(folder: Path) -> None:
    points: list[dict[str, Any]] = [
        {"name": str(i), "position": [0.2 * (i % 2), 0.1 * i, 0.0], "pixel": [10 + i, 20.5]}
        for i in range(3)
    ]
    points += [{"position": [1, 1, 1], "patch": "corner.png"}]
    (folder / "target.json").write_text(json.dumps({"points": points, "unit": "metre"}, indent=1))
    cv2.imwrite(str(folder / "corner.png"), picture(0)[:20, :20])


def write_film(folder: Path) -> None:
    path, code = str(folder / "film.mp4"), cv2.VideoWriter.fourcc(*"mp4v")
    writer = cv2.VideoWriter(path, code, 25.0, (WIDTH, HEIGHT))
    for index in range(4):
        writer.write(cv2.cvtColor(picture(index), cv2.COLOR_GRAY2BGR))
    writer.release()


def small_study(folder: Path) -> Any:
    scenario = jaxslam.scenario("matched-tight", steps=2, landmarks=3)
    store = FolderStore(folder, {"made_by": "fuzz", "seed": 0}, resume=True)
    return jaxslam.monte_carlo(scenario, "robocentric", runs=4, chunk=2, store=store)


def write_tracker(folder: Path) -> None:
    source = synthetic_source(frames=1, width=160, height=120)
    settings = jaxslam.TrackerSettings(filter="world", wanted=12, spare=4)
    tracker = jaxslam.Tracker(source.calibration, settings)
    for frame in source:
        tracker.track(frame)
    tracker.save(folder / "tracker.npz")


def write_record_of_two(folder: Path) -> None:
    numbers = {"a": np.zeros(3), "b": np.ones((2, 2))}
    write_record(folder / "tracker.npz", {"filter": None, "settings": {}}, numbers)


# --- what reads -----------------------------------------------------------------------------------


def read_poses(folder: Path, draw: Draw) -> Any:
    arrays: list[Any] = list(logged(Convention(), runs=3, steps=5))
    spoilt = int(draw.integers(3))
    arrays[spoilt] = mutated_array(draw, arrays[spoilt])
    try:
        convention = Convention(**{key: one_of(draw, values) for key, values in CHOICES.items()})
    except ValueError:
        convention = Convention()
    return evaluate_poses(*arrays, convention, align=one_of(draw, ALIGN))


def read_errors(folder: Path, draw: Draw) -> Any:
    arrays: list[Any] = list(drawn(4, 5))
    spoilt = int(draw.integers(2))
    arrays[spoilt] = mutated_array(draw, arrays[spoilt])
    return evaluate(*arrays, quantity=one_of(draw, ("NEES", "NIS")))


def read_source(name: str = "") -> Callable[[Path, Draw], Any]:
    def read(folder: Path, draw: Draw) -> Any:
        source = open_source(folder / name)
        frames = [(frame.time, frame.image.shape) for frame in source]
        assert all(a[0] < b[0] for a, b in itertools.pairwise(frames)), "times"
        return source.calibration, source.times, source.reference, frames

    return read


OVERRIDES = ("pixel_sigma=0.5", "velocity=[1,2,3]", "steps=7", "calibration=white", "rate=30")
NAMES = (
    "world", "robocentric+oc", "scale_gauge+scene50+mixture3+rest8", "recommended+submaps",
    "nothing",
)  # fmt: skip


def read_override(folder: Path, draw: Draw) -> Any:
    text = mutated_text(draw, one_of(draw, OVERRIDES)).strip("\n")
    return jaxslam.scenario("circle", dict([parse_override(text)]))


def read_filter(folder: Path, draw: Draw) -> Any:
    name = mutated_text(draw, one_of(draw, NAMES).replace("+", " "))
    return list(jaxslam.make_filters("matched", name.strip("\n").replace(" ", "+"), "cartesian"))


PIECES: list[tuple[Callable[..., Any], list[Any]]] = [
    (jaxslam.Camera, [[650.0], [320.0]]),
    (jaxslam.Camera, [[650.0, 650.0], [320.0, 240.0], [0.0] * 5]),
    (lambda sigma: jaxslam.Pinhole(jaxslam.Camera([650.0], [320.0]), sigma), [0.3]),
    (jaxslam.ConstantVelocity, [[0.1] * 3, [1.0, 0.0, 0.0], [0.1] * 3]),
    (jaxslam.Odometry, [[0.1] * 6]),
    (jaxslam.InverseDepth, [0.5, 0.25]),
    (jaxslam.RangeBearing, [[0.1, 0.2]]),
]


def read_pieces(folder: Path, draw: Draw) -> Any:
    make, told = one_of(draw, PIECES)
    i = int(draw.integers(len(told)))
    made = make(*told[:i], mutated_array(draw, np.asarray(told[i])), *told[i + 1 :])
    return made.geometry if isinstance(made, jaxslam.AbstractMotion) else None


def _file(name: str, read: Callable[[Path], Any]) -> Callable[[Path, Draw], Any]:
    return lambda folder, draw: read(folder / name)


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


def run_wrong_command(folder: Path, draw: Draw) -> Any:
    words = [*one_of(draw, BAD_ARGUMENTS), one_of(draw, REFUSED)]
    status, _ = _commanded([*words, "--out", str(folder / "out")])
    assert status == 2, f"{words} ended with {status}"


def run_evaluate(folder: Path, draw: Draw) -> Any:
    (source,), out = [*folder.iterdir()] or [folder], folder / "out"
    status, error = _commanded(["evaluate", str(source), "--out", str(out)])
    if status:
        assert status == 2, f"ended with {status}"
        assert error.count("\n") == 1, error
        assert error.startswith("jaxslam: "), error
        return None
    assert sorted(path.name for path in out.iterdir()) == ["evaluation.json", "evaluation.png"]
    return json.loads((out / "evaluation.json").read_text(), parse_constant=_no_number)


def _no_number(word: str) -> Any:
    raise AssertionError(f"{word} in a JSON file")


def _commanded(arguments: list[str]) -> tuple[int, str]:
    """A command's exit status and what it says to standard error."""
    error = io.StringIO()
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(error):
            command(arguments)
    except SystemExit as stop:
        return int(stop.code or 0), error.getvalue()
    return 0, error.getvalue()


TARGETS: dict[str, Target] = {
    "evaluate": Target(nothing, read_errors),
    "evaluate_poses": Target(nothing, read_poses),
    "evaluate_log folder": Target(
        write_run, lambda folder, draw: evaluate_log(folder, align=one_of(draw, ALIGN))
    ),
    **{f"evaluate_log {name}": Target(log.write, log.evaluated, 0.3) for name, log in LOGS.items()},
    "jaxslam evaluate": Target(LOGS["npz of errors"].write, run_evaluate, 0.05),
    "jaxslam, wrong": Target(nothing, run_wrong_command, 0.3),
    "read_tum": Target(lambda x: recordings.write(x / "t.txt", np.arange(30) / 30),
                       _file("t.txt", read_tum)),
    "scenario": Target(write_scenario, _file("s.toml", jaxslam.scenario)),
    "override": Target(nothing, read_override),
    "make_filters": Target(nothing, read_filter),
    "pieces": Target(nothing, read_pieces),
    "read_calibration": Target(lambda x: write_calibration(x / "camera.json", videos.OWN),
                               _file("camera.json", read_calibration)),
    "read_target": Target(write_target, _file("target.json", read_target)),
    "open_source timestamps": Target(videos.timestamped, read_source()),
    "open_source tum": Target(videos.tum_rgbd, read_source("rgbd_dataset_freiburg2_desk")),
    "open_source euroc": Target(videos.euroc, read_source("MH_01_easy")),
    "open_source kitti": Target(videos.kitti, read_source("sequences/06")),
    "open_source 7scenes": Target(videos.seven_scenes, read_source("seq-01")),
    "open_source pictures": Target(videos.plain, read_source()),
    "open_source film": Target(write_film, read_source("film.mp4"), 0.5),
    **{f"open_source {name}": Target(videos.bag(name), read_source(name)) for name in KINDS},
    "read_record": Target(write_record_of_two, _file("tracker.npz", lambda x: read_record(x)[0])),
    "Tracker.load": Target(
        write_tracker, _file("tracker.npz", lambda x: jaxslam.Tracker.load(x).settings), 0.05),
    "resume": Target(small_study, lambda x, _: jaxslam.summarise(small_study(x)), 0.2),
}  # fmt: skip


# --- how it ends ----------------------------------------------------------------------------------


def problem(target: Target, folder: Path, trap: Path, draw: Draw) -> str:
    """What is wrong with how a case ends; nothing if it ends as it must."""
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
    halves = [path.name for path in folder.rglob(f".{os.getpid()}.*")]  # of a temporary file
    return wrong or (f"left behind: {', '.join(halves)}" if halves else "")


def _not_finite(result: Any) -> str:
    if isinstance(result, Evaluation):  # an infinite NEES is one of a run that diverged
        json.dumps(result.asdict(), allow_nan=False)
        assert str(result)
        return "" if result.logged.any(axis=1).all() else "a run without a NEES"
    bad = next((place for place, x in _numbers(result, "result") if not np.isfinite(x).all()), None)
    return f"{bad} is not finite" if bad else ""


def _numbers(x: Any, place: str) -> Iterator[tuple[str, np.ndarray]]:
    """All floating-point numbers in a result, with where they are."""
    if isinstance(x, float | np.ndarray | jax.Array):
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

    def case(self, index: int) -> str:
        """Run one case; what did not end as it must, or nothing."""
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
        return f"case {index}, {name}: {what}" if what else ""


def main(cases: int = 1000, first: int = 0, seed: int = 0, only: str = "") -> None:
    """Run so many cases of the targets whose names have a part in common; print the findings."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    start, found = time.perf_counter(), 0
    with tempfile.TemporaryDirectory() as folder:
        fuzz = Fuzz(Path(folder), seed, only)
        for index in range(first, first + cases):
            if finding := fuzz.case(index):
                found += 1
                print(finding, flush=True)
    print(f"{cases} cases in {time.perf_counter() - start:.0f} s, {found} findings")
    sys.exit(min(found, 1))


if __name__ == "__main__":
    tyro.cli(main)
