"""Tests of the benchmark of filters from rest: what its table says, and where it is written."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import from_rest as benchmark
import numpy as np
from benchmark import END
from from_rest import BEGIN, FromRest, as_table

from jaxslam.statistics import run_verdict

STEPS = 60


def found(**changed):
    numbers = {
        "runs": 50,
        "seed": 3,
        "dof": 3,
        "band95": [2.4, 3.7],
        "nees": [4.0] * STEPS,
        "nees_not_lost": [3.0] * STEPS,
        "reversed": [None] + [0.0] * (STEPS - 1),
        "lost": [0.25] * STEPS,
        "lost_ever": [0.5] * STEPS,
        "rmse": {"position": [0.1] * STEPS},
        "sigma": {"position": [0.2] * STEPS},
        "milliseconds_per_run": 1500.0,
    }
    return numbers | changed


def test_a_row_says_at_every_frame_what_is_lost_and_how_true_the_others_are():
    nees: list[Any] = [3.0] * STEPS
    nees[9], nees[-1] = 7.25, None
    row = as_table({"standstill": {"mine": found(nees_not_lost=nees)}}).splitlines()[-1]
    assert row.split(" | ") == [
        "| `mine`", "50; 2.40–3.70", "25, 25, 25, 25", "4.0, 4.0, 4.0, 4.0",
        "3.0, 3.0, 7.2, –", "50.0%", "0.10; 0.20", "1.5 |",
    ]  # fmt: skip


def test_the_sentences_are_of_the_numbers_of_all_runs():
    nees: list[Any] = [3.0] * STEPS
    lost, reversed_ = [0.0] * STEPS, [None, *[0.0] * (STEPS - 1)]
    # A mean that does not exist is above the band.
    nees[8], nees[9], nees[33], nees[40] = 9.0, 3.8, None, 2.3
    lost[8], lost[33], reversed_[56] = 0.5, 0.1, 0.02
    numbers = found(nees=nees, lost=lost, reversed=reversed_)
    results = {"standstill": {"mine": numbers, "mine+rest8": numbers}}
    (said,) = benchmark.sentences(results).splitlines()
    assert said.startswith("- `standstill`, `mine+rest8`: of 50 runs (seed 3) at most 5 are lost")
    assert "at most 1 is reversed at any of frames 10 to 60" in said
    assert "above its band at 2 of these 51 frames and below it at 1." in said
    assert said.endswith("The verdict was not recorded.")
    with_verdicts = {
        "verdict": run_verdict(np.random.default_rng(0).chisquare(3, (50, STEPS)) * 2.0, 3),
        "beyond_scale": {"verdict": run_verdict(np.full((50, STEPS), 2.5), 3, fitted=1.0)},
        "scale_drift": {"verdict": None},
    }
    said = benchmark.sentences({"standstill": {"mine+rest8": numbers | with_verdicts}})
    assert "over-confident" in said.split("Over all frames: ")[1].split("At one scale a run:")[0]


def test_the_page_says_what_the_numbers_on_disk_say():
    folder = Path(__file__).resolve().parents[2]
    results = json.loads((folder / "benchmarks/results/from_rest.json").read_text())
    page = (folder / "docs/from-rest.md").read_text()
    for part in (as_table(results), benchmark.sentences(results)):
        assert f"\n\n{part}\n\n" in page


def test_other_pages_quote_the_numbers_on_disk():
    folder = Path(__file__).resolve().parents[2]
    results = json.loads((folder / "benchmarks/results/from_rest.json").read_text())
    space = results["standstill-6dof"]["scale_gauge+scene50+mixture3+rest8"]
    plane = results["standstill"]["scale_gauge+scene50+mixture5+rest"]
    lost, above = zip(*(_at_most_lost_and_above(found) for found in (space, plane)), strict=True)
    which = re.sub("<!--.*?-->", "", (folder / "docs/which-filter.md").read_text(), flags=re.S)
    which = " ".join(which.split())
    assert f"of {plane['runs']} runs at most {lost[1] / plane['runs']:.1%}" in which.replace(
        " %", "%"
    )
    for runs in above:
        assert f"above its band at {runs} of these 51 frames" in which
    words = {5: "five", 7: "seven"}
    assert f"of {space['runs']} runs at most {words[lost[0]]} lost" in which
    page = re.sub("<!--.*?-->", "", (folder / "docs/results.md").read_text(), flags=re.S)
    page = page.replace("\n", " ")
    assert f"of {space['runs']} simulated runs at most {words[lost[0]]} are lost" in page
    assert f"of {plane['runs']} at most {words[lost[1]]}" in page


def _at_most_lost_and_above(found):
    lost = max(round(found["runs"] * x) for x in found["lost"][9:60])
    return lost, sum(not x <= found["band95"][1] for x in found["nees"][9:60])


def test_what_is_there_is_not_measured_again(tmp_path, monkeypatch):
    options = FromRest(
        scenarios=("standstill",), filters=("mine",), runs=50, seed=3,
        out=tmp_path / "found.json", docs=tmp_path,
    )  # fmt: skip
    page = tmp_path / "from-rest.md"
    page.write_text(f"{BEGIN}\n{END}\n{benchmark.SAID}\n{END}\n")
    options.out.write_text(json.dumps({"standstill": {"mine": found()}}))
    monkeypatch.setattr(benchmark, "measure", lambda *_: found(runs=51, seed=3))
    options()
    assert "| 50; 2.40" in page.read_text()
    replace(options, runs=51)()
    assert "| 51; 2.40" in page.read_text()
