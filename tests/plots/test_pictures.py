"""No picture of a page is older than the program that draws it."""

import json
from pathlib import Path

import PIL.Image
from evaluation_figure import evaluation_of

from jaxslam.plots import new_figure, plot_evaluation
from jaxslam.plots.style import drawn, save
from jaxslam.statistics.verdict import headline

DOCS = Path(__file__).parents[2] / "docs"


def shown(path):
    """What a picture says that it shows."""
    with PIL.Image.open(path) as picture:
        return json.loads(picture.info["Drawn"])


def test_a_picture_says_what_is_drawn(tmp_path):
    figure = new_figure(3.0, 2.0)
    figure.suptitle("NEES 3.05, σ ×")
    figure.subplots().set_ylabel("NEES")
    save(figure, tmp_path / "a.png")
    expected = {"inches": [3.0, 2.0], "title": "NEES 3.05, σ ×", "axes": [["", "", "NEES"]]}
    assert shown(tmp_path / "a.png") == expected
    save(figure, tmp_path / "a.pdf")  # and no PDF is refused


def test_the_first_picture_is_of_the_stored_study():
    """`python benchmarks/circle.py` draws it, and stores what it says beside the verdicts."""
    stored = json.loads((DOCS.parent / "benchmarks/results/circle.json").read_text())
    assert shown(DOCS / "consistency.png") == stored["drawn"]
    said = stored["drawn"]["title"].splitlines()
    for line, (name, seeds) in zip(said[:-1], stored["verdicts"].items(), strict=True):
        assert line.startswith(f"{name}: {headline(seeds['0'])}")
    assert said[-1].startswith(f"circle, {stored['runs']} runs, seed 0")


def test_the_picture_of_evaluations_is_of_its_page():
    """`python benchmarks/evaluation_figure.py` draws it."""
    figure = plot_evaluation(evaluation_of((DOCS / "evaluate.md").read_text()))
    assert shown(DOCS / "evaluate.png") == json.loads(drawn(figure))
