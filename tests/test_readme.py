"""The examples of the README and of the documents run."""

import json
import re
import shlex
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
import tyro

import jaxslam
from jaxslam.cli import main
from jaxslam.cli.commands import Command
from jaxslam.evaluation import CHOICES, Convention, read_covariances
from jaxslam.tracking.synthetic import synthetic_source
from jaxslam.tracking.target import read_target

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


def examples(document: str) -> list[str]:
    """The document's marked snippets."""
    text = (ROOT / document).read_text()
    return re.findall(r"<!-- runs as a test -->\n```python\n(.*?)```", text, re.DOTALL)


def run_example(document: str) -> str:
    """Execute the document's marked snippets, each by itself, and return the first."""
    for snippet in examples(document):
        exec(compile(snippet, document, "exec"), {"__name__": __name__})
    return examples(document)[0]


@pytest.mark.slow
def test_the_library_example_runs_and_prints_a_table(capsys):
    snippet = run_example("README.md")
    assert len(snippet.strip().splitlines()) <= 13
    assert "robocentric/inverse_scaling" in capsys.readouterr().out


def test_the_study_of_the_readme_prints_what_is_stored_of_it():
    """`python benchmarks/circle.py` stores the verdicts of its command."""
    stored = json.loads((ROOT / "benchmarks/results/circle.json").read_text())
    page = (ROOT / "README.md").read_text()
    block = "".join(f"    {name}:\n        {said}\n" for name, said in stored["printed"].items())
    assert f"\n{block}\n" in page


@pytest.mark.slow
def test_a_filter_of_ones_own_takes_part_in_a_study(capsys):
    run_example("docs/own-filter.md")
    lines = capsys.readouterr().out.splitlines()
    assert ": consistent (p = " in lines[lines.index("mine:") + 1]


def test_an_inertial_unit_is_a_motion_as_its_page_says(capsys):
    run_example("docs/inertial.md")
    assert capsys.readouterr().out.split("[")[1].split("]")[0].split() == ["0.", "-0.981", "0."]


def test_axes_angles_and_controls_are_as_their_page_says():
    assert len(examples("docs/axes.md")) == 1
    run_example("docs/axes.md")


@pytest.mark.slow
def test_a_log_of_ones_own_goes_through_the_filter(capsys, tmp_path, monkeypatch):
    """And a world, a sensor and a motion of one's own, with consistent numbers."""
    monkeypatch.chdir(tmp_path)
    _, study, *_ = examples("docs/own-data.md")
    assert len([x for x in study.splitlines() if x]) <= 10
    run_example("docs/own-data.md")
    assert Path("study.png").stat().st_size > 10_000
    out = capsys.readouterr().out
    printed = re.search(r"\[([^]]*)\] ±", out)
    assert printed is not None
    position = [float(x) for x in printed[1].split()]
    assert abs(position[0] - 1.5) < 0.2
    assert abs(position[1]) < 0.2
    for name in ("bearings:", "biased:"):
        assert "over-confident" not in out[out.index(name) :].splitlines()[1]


def test_the_papers_filter_is_put_together_of_its_equations(capsys):
    run_example("docs/paper.md")
    assert capsys.readouterr().out.startswith("(47, 47)")


def test_errors_of_any_filter_have_a_verdict(capsys, tmp_path, monkeypatch):
    """And trajectories with covariances have one, by way of their files."""
    monkeypatch.chdir(tmp_path)
    assert len(examples("docs/evaluate.md")) == 2
    run_example("docs/evaluate.md")
    out = capsys.readouterr().out
    promised = "NEES 5.03, σ too small by 1.29 [1.26, 1.33]: over-confident (p < 0.0001)"
    assert promised in (ROOT / "docs/evaluate.md").read_text()
    assert out.startswith(promised)
    assert json.loads(Path("results/evaluation.json").read_text())["runs"] == 50
    assert sum(line.startswith("axis ") for line in out.splitlines()) == 2  # two tables


@pytest.mark.slow
def test_the_filter_of_the_page_is_the_classical_one(tmp_path, monkeypatch):
    """As the page says: its numbers are those of `world`, of the same runs."""
    monkeypatch.chdir(tmp_path)
    some = ["--scenario", "matched", "matched-loose", "--runs", "3"]
    main(["evaluate", "--suite", "suite", *some])
    run_example("docs/suite.md")
    main(["evaluate", "mine", "--suite", "suite", "--error", "split", "--filters", "world"])
    found = json.loads(Path("results/suite.json").read_text())["scenarios"]
    assert set(found) == {"matched", "matched-loose"}
    for filters in found.values():
        yours, ours = filters["yours"], filters["world/inverse_scaling"]
        np.testing.assert_allclose(yours["nees"], ours["nees"], rtol=0.02)
        np.testing.assert_allclose(yours["rmse"]["position"], ours["rmse"]["position"], rtol=0.01)


@pytest.mark.slow
def test_a_landmark_of_ones_own_goes_into_the_papers_filter(capsys):
    run_example("docs/own-landmark.md")
    lines = capsys.readouterr().out.splitlines()
    plain, papers = (lines[lines.index(f"{name}:") + 1] for name in ("plain", "paper"))
    assert ": consistent (p = " in plain
    assert plain == papers  # the calibration is known: the two differ by a factor f


def test_a_study_is_kept_in_files(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_example("docs/large-studies.md")
    counted, shape, apart = capsys.readouterr().out.splitlines()
    assert (counted, shape) == ("60 runs in 3 files", "(60, 5)")
    assert [float(x) for x in apart.strip("[]").split()] == [0.0] * 5
    files = sorted(Path("results/runs").glob("*/*.npz"))
    written = [file.stat().st_mtime_ns for file in files]
    run_example("docs/large-studies.md")  # goes on from there: nothing is run again
    assert [file.stat().st_mtime_ns for file in files] == written


@pytest.mark.slow
def test_the_sites_first_page_has_ten_lines(capsys):
    snippet = run_example("docs/index.md")
    assert len(snippet.strip().splitlines()) <= 10
    assert "scale_gauge+mixture9/inverse_scaling" in capsys.readouterr().out


@pytest.mark.slow
def test_a_film_goes_through_the_tracker_in_python(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    source = synthetic_source(frames=6, width=320, height=240)
    writer = cv2.VideoWriter("walk.mp4", cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (320, 240))
    for frame in source:
        writer.write(cv2.cvtColor(frame.image, cv2.COLOR_GRAY2BGR))
    writer.release()
    run_example("docs/own-video.md")
    assert Path("tracker.npz").stat().st_size > 0


@pytest.mark.slow
def test_old_cameras_of_submaps_have_covariances(capsys):
    run_example("docs/submaps.md")
    assert capsys.readouterr().out == "4 cameras\n"


def test_every_snippet_of_every_page_runs():
    """Each document with snippets is run by a test of this file; what is not run says why."""
    tests = Path(__file__).read_text()
    for path in DOCUMENTS:
        text, name = path.read_text(), str(path.relative_to(ROOT))
        excused = text.count("<!-- does not run as a test: ")
        assert text.count("```python") == len(examples(name)) + excused, name
        assert not examples(name) or f'run_example("{name}")' in tests, name


OURS = r"jaxslam \w+|python benchmarks/\w+\.py|python -m benchmarks\.\w+"
SAYS = re.compile("…|--help|--version|python -c|python -m p")
"""What is no command of ours to be checked: one that is abridged, ends at once, or is Python's."""


def commands() -> list[str]:
    """Command lines of `jaxslam` and of benchmarks in blocks and between backticks, all pages."""
    found: set[str] = set()
    for path in DOCUMENTS:
        text = path.read_text()
        blocks = "\n".join(re.findall(r"```sh\n(.*?)```", text, re.DOTALL))
        told = re.findall(r"^((?:jaxslam|python) .*)$", blocks, re.MULTILINE)
        told += re.findall(rf"`((?:{OURS}) [^`\n]+)`", text)
        found |= {line.partition(" #")[0].strip() for line in told if not SAYS.search(line)}
    return sorted(found)


def test_every_command_of_every_page_is_accepted():
    """Its options and their kinds, without being run."""
    checked = [line for line in commands() if line.startswith("jaxslam ")]
    assert len(checked) > 20
    for line in checked:
        options = tyro.cli(Command, args=shlex.split(line)[1:], config=(tyro.conf.OmitArgPrefixes,))
        assert hasattr(options, "run"), line


def sources(words: list[str]) -> list[Path]:
    """The files of the program that `python` is told to run: `FILE.py` or `-m PACKAGE`."""
    if words[0] != "-m":
        return [ROOT / words[0]]
    package = ROOT / words[1].replace(".", "/")
    assert (package / "__main__.py").is_file(), words
    return sorted(package.glob("*.py"))


def test_every_benchmark_of_every_page_is_there_with_its_options():
    checked = [line for line in commands() if line.startswith("python ")]
    assert len(checked) > 2
    for line in checked:
        source = "".join(path.read_text() for path in sources(line.split()[1:]))
        for option in re.findall(r"--([\w-]+)", line):
            assert re.search(rf"\b{option.replace('-', '_')}\b", source), (line, option)


def test_the_scenario_file_of_the_page_is_one(tmp_path):
    (snippet,) = re.findall(r"```toml\n(.*?)```", (ROOT / "docs/data.md").read_text(), re.DOTALL)
    (tmp_path / "mine.toml").write_text(snippet)
    mine = jaxslam.scenario(str(tmp_path / "mine.toml"))
    assert mine.pixel_sigma == tomllib.loads(snippet)["pixel_sigma"]
    assert mine.ring_radius == jaxslam.scenario("circle").ring_radius


def test_the_target_of_the_page_is_one(tmp_path):
    page = (ROOT / "docs/own-video.md").read_text()
    (snippet,) = re.findall(r"```json\n(.*?)```", page, re.DOTALL)
    (tmp_path / "target.json").write_text(snippet)
    for name in re.findall(r'"([\w-]+\.png)"', snippet):
        patch = np.random.default_rng(0).integers(0, 255, (15, 15)).astype(np.uint8)
        cv2.imwrite(str(tmp_path / name), patch)
    assert len(read_target(tmp_path / "target.json").points) == snippet.count('"name"')


def test_the_covariance_file_of_the_page_is_one(tmp_path):
    """Its keys and defaults are those of the reader."""
    page = (ROOT / "docs/covariance-format.md").read_text()
    header = next(line.strip() for line in page.splitlines() if "# t xx" in line)
    numbers = " ".join(["1"] * 22)
    (tmp_path / "c.txt").write_text(f"{header}\n{numbers}\n")
    assert read_covariances(tmp_path / "c.txt").convention == Convention()
    for key, choices in CHOICES.items():
        assert all(f"`{choice}`" in page for choice in choices), key
