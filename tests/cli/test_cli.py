"""Tests of the command line: files and their keys, errors of one line, resuming."""

import errno
import itertools
import json
import runpy
import subprocess
import sys
import threading

import pytest
from refusals import ended, refused

import jaxslam
from jaxslam.cli import main
from jaxslam.cli.evaluate import RIVALS
from jaxslam.cli.extra import seconds
from jaxslam.consistency import BACKENDS, DTYPES
from jaxslam.consistency.montecarlo import Interruption
from jaxslam.consistency.suite import SUITE
from jaxslam.evaluation import CHOICES
from jaxslam.evaluation.alignment import ALIGNMENTS
from jaxslam.models.calibration import TREATMENTS
from jaxslam.triangulation import CALIBRATIONS as VIEWS

SMALL = ["consistency", "--scenario", "matched-tight", "--steps", "6", "--runs", "6"]
OPTIONS = ["--seed", "7", "--dtype", "float32", "--backend", "native", "--reduce"]
OPTIONS += ["--cluster", "tcp://127.0.0.1:9"]
FILTER_KEYS = {
    "dof", "band95", "nees", "nees_median", "lost", "inside", "nis", "nis_dof", "rmse", "sigma",
    "landmark_nees", "landmark_dof", "landmark_not_finite", "diverged", "seconds", "lost_ever",
    "survivors", "verdict", "beyond_scale", "log_scale", "reversed",
}  # fmt: skip


VERDICT_KEYS = {
    "nees", "sigma_factor", "interval99", "p", "word", "runs", "lost", "diverged", "end",
    "never_lost",
}  # fmt: skip


@pytest.mark.slow
def test_consistency_writes_what_others_read_and_resumes(tmp_path, capsys):
    """No quick test sends a whole study through the command."""
    whole = [*SMALL, "--chunk", "3", "--out", str(tmp_path), "--set", "pixel_sigma=0.4"]
    main(whole)
    summary = json.loads((tmp_path / "consistency.json").read_text())
    assert summary["schema"] == 1
    assert (summary["runs"], summary["steps"], summary["seed"]) == (6, 6, 0)
    assert summary["scenario"]["pixel_sigma"] == 0.4
    assert set(summary["filters"]) == {"robocentric/inverse_scaling", "robocentric/inverse_depth"}
    for result in summary["filters"].values():
        assert result.keys() >= FILTER_KEYS
        assert result["verdict"].keys() >= VERDICT_KEYS
        assert len(result["nees"]) == len(result["lost"]) == len(result["lost_ever"]) == 6
    assert (tmp_path / "consistency.png").read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr().out
    assert printed.startswith("robocentric/inverse_scaling:\n    NEES ")
    assert "robocentric/inverse_depth" in printed
    assert "at one scale a run" in printed
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"consistency.json", "consistency.png", "runs"}
    main([*whole, "--resume"])
    again = json.loads((tmp_path / "consistency.json").read_text())["filters"]
    for name, result in again.items():
        assert result["nees"] == summary["filters"][name]["nees"]
        assert result["seconds"]["run"] == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["consistency", "--runs", "0"], "runs must be at least 1, not 0"),
        (["consistency", "--scenario", "cirle"], "did you mean circle?"),
        (["consistency", "--scenario", "missing.toml"], "missing.toml does not exist"),
        (["consistency", "--landmarks", "inverse_scale"], "did you mean inverse_scaling?"),
        (["consistency", "--filters", "nothing"], "known: robocentric, world"),
        (["consistency", "--set", "pixel_sigma=nan"], "pixel_sigma holds nan"),
        (["consistency", "--set", "pixel_sigma"], "not of the form field=value"),
        (["evaluate", "--suite", "mine", "--scenario"],
         "a suite needs at least one scenario; by d"),
        (["track", "/no/such/folder"], "/no/such/folder"),
        (["track", "--reference", "truth.txt"], "need a SOURCE"),
        (["track", "--frames", "0"], "frames"),
        (["track", "--fov", "60"], "need a SOURCE"),
        (["track", "--calibration-treatment", "maybe"], "unknown calibration 'maybe'"),
        *(
            (["track", "--readout", time], f"such as 20ms or 0.02s, not '{time}'")
            for time in ("20 m", "", "1..2ms", "20ms later")
        ),
        (["track", "--filter", "nothing"], "unknown filter 'nothing'"),
        (["track", "--filter", "world+rays", "--landmarks", "cartesian"],
         "RaySum takes a frame as a whole"),
    ],
)  # fmt: skip
def test_a_mistake_ends_with_status_2_and_one_line(arguments, message, tmp_path, capsys):
    if arguments[0] in ("track", "calibrate"):
        pytest.importorskip("cv2")
    ended(message, arguments, tmp_path / "out", capsys)


def ended_of(code):
    """What a process of its own leaves, in which a warning is an error."""
    command = [sys.executable, "-W", "error", "-c", code]
    return subprocess.run(command, capture_output=True, text=True, timeout=50, check=False)


def test_a_reader_that_has_enough_ends_a_command_quietly():
    """As `jaxslam evaluate … | head -1`, whatever is still in the buffer."""
    code = """
import types, jaxslam.cli, jaxslam.cli.commands as commands
def run():
    for line in range(100_000):
        print("line", line)
commands.parse = lambda given: types.SimpleNamespace(run=run)
jaxslam.cli.main([])
"""
    command = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert command.stdout is not None
    assert command.stdout.readline() == "line 0\n"
    command.stdout.close()
    _, error = command.communicate(timeout=60)
    assert (command.returncode, error) == (141, "")


@pytest.mark.parametrize("swallowed", ["as an object ends", "by an import", "as another error"])
def test_an_interruption_is_heard_wherever_it_comes_and_waits_for_no_thread(swallowed):
    code = f"""
import os, signal, sys, threading, time, types, jaxslam.cli, jaxslam.cli.commands as commands
threading.Thread(target=time.sleep, args=(100,)).start()
swallowed = "{swallowed}"
# A shell's job in the background has it ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)
def pressed():
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(60)
class Ends:
    def __del__(self):
        pressed()
def parse(given):
    try:
        pressed() if swallowed == "by an import" else None
    except KeyboardInterrupt:
        pass
    return types.SimpleNamespace(run=run)
def run():
    try:
        Ends() if swallowed == "as an object ends" else pressed()
        time.sleep(60)
    except KeyboardInterrupt:
        if swallowed == "as another error":
            raise RuntimeError("a callback failed") from None
        raise
commands.parse = parse
jaxslam.cli.main()
"""
    ended = ended_of(code)
    assert (ended.returncode, ended.stderr) == (130, "jaxslam: interrupted\n")


@pytest.mark.parametrize("kept", [0, 2])
def test_an_interrupted_study_says_what_is_kept_and_how_to_go_on(
    kept, tmp_path, monkeypatch, capsys
):
    asked = {}

    def interrupted(world, filters, *, store, chunk, **more):
        asked.update(more, steps=world.steps)
        raise Interruption(kept, 12, chunk, store)

    monkeypatch.setattr("jaxslam.cli.consistency.monte_carlo", interrupted)
    with pytest.raises(SystemExit) as ended:
        main([*SMALL, *OPTIONS, "--chunk", "2", "--out", str(tmp_path)])
    assert ended.value.code == 130
    assert asked == {
        "runs": 6, "steps": 6, "seed": 7, "dtype": "float32", "backend": "native", "reduced": True,
        "cluster": "tcp://127.0.0.1:9", "progress": True,
    }  # fmt: skip
    told = (
        f"2 of 12 runs are kept in {tmp_path}; the same command with --resume goes on from there"
        if kept
        else f"no chunk of 2 runs was finished, so that nothing of 12 is kept in {tmp_path}; with "
        "a smaller --chunk the first runs are kept sooner"
    )
    assert capsys.readouterr().err.splitlines()[-1] == f"jaxslam: interrupted: {told}"


def test_a_command_within_a_program_does_not_end_it(capsys):
    """Nor a notebook's kernel, whatever goes on in other threads."""
    done = threading.Event()
    other = threading.Thread(target=done.wait, args=(60,))
    other.start()
    try:
        with pytest.raises(SystemExit) as ended:
            main(["evaluate", "nowhere.csv"])
        assert ended.value.code == 2
        assert "nowhere.csv" in capsys.readouterr().err
    finally:
        done.set()
        other.join()


def test_a_full_disk_is_told(monkeypatch, capsys):
    def full(given):
        raise OSError(errno.ENOSPC, "No space left on device", *given)

    monkeypatch.setattr("jaxslam.cli._run", full)
    for given, told in (([], "writing"), (["film.mp4"], "film.mp4")):
        with pytest.raises(SystemExit) as ended:
            main(given)
        assert ended.value.code == 2
        assert capsys.readouterr().err == f"jaxslam: {told}: No space left on device\n"


def as_a_module(arguments):
    """As `python -m jaxslam.cli` starts it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["jaxslam", *arguments])
        runpy.run_module("jaxslam.cli", run_name="__main__")


@pytest.mark.parametrize("start", [main, as_a_module])
def test_the_version_is_told(start, capsys):
    start(["--version"])
    assert capsys.readouterr().out == f"jaxslam {jaxslam.__version__}\n"


@pytest.mark.parametrize(
    ("command", "accepted"),
    [
        ("consistency", [*TREATMENTS, *BACKENDS, *DTYPES]),
        ("evaluate", [*itertools.chain(*CHOICES.values()), *ALIGNMENTS, *SUITE, *RIVALS]),
        ("track", [*TREATMENTS]),
        ("triangulate", [*VIEWS]),
    ],
)
def test_help_names_what_is_accepted(command, accepted, capsys):
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    assert stop.value.code == 0
    told = capsys.readouterr().out
    assert not [name for name in accepted if name not in told]


@pytest.mark.parametrize(
    ("told", "expected"),
    [
        ("20ms", 0.02),
        ("0.02 s", 0.02),
        ("50us", 5e-5),
        ("7µs", 7e-6),
        ("-3.5e-2", -0.035),
        (".5", 0.5),
    ],
)
def test_a_time_may_have_a_unit(told, expected):
    assert seconds("--readout", told) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("told", ["soon", "", "20 min", "nan", "inf", "1e999", "--3"])
def test_what_is_no_time_is_refused_by_its_option(told):
    refused(seconds, "^--readout is a time such as 20ms or 0.02s, not '", "--readout", told)
