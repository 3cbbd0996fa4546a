"""Tests of the benchmark of filters from rest: what its table says, and where it is written."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

import from_rest as benchmark
from from_rest import BEGIN, Options, main, table
from pages import END, write_table

STEPS = 60


def found(**changed):
    numbers = {
        "runs": 50,
        "seed": 3,
        "dof": 3,
        "band95": [2.4, 3.7],
        "nees_not_lost": [3.0] * STEPS,
        "lost": [0.25] * STEPS,
        "lost_ever": [0.5] * STEPS,
        "rmse": {"position": [0.1] * STEPS},
        "sigma": {"position": [0.2] * STEPS},
        "milliseconds_per_run": 1500.0,
    }
    return numbers | changed


def test_a_row_says_at_every_frame_what_is_lost_and_how_true_the_others_are():
    nees: list[Any] = [3.0] * STEPS
    nees[5], nees[-1] = 7.25, None
    row = table({"standstill": {"mine": found(nees_not_lost=nees)}}).splitlines()[-1]
    assert row.split(" | ") == [
        "| `mine`", "50 (seed 3), 2.40–3.70", "25.0%; 3.0", "25.0%; 3.0", "25.0%; 7.2",
        "25.0%; 3.0", "25.0%; 3.0", "25.0%; 3.0", "25.0%; –", "50.0%", "0.100, 0.200", "1.5 |",
    ]  # fmt: skip


def test_the_table_stands_in_its_place_and_replaces_the_old_one(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    write_table(page, BEGIN, table({"standstill": {"mine": found()}}))
    new = page.read_text()
    assert new.startswith("before\n")
    assert new.endswith("\nafter\n")
    assert "old" not in new
    assert "`mine`" in new
    write_table(page, BEGIN, table({"standstill": {"mine": found()}}))
    assert page.read_text() == new


def test_a_page_without_a_place_is_refused(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(f"a page with {END}")
    with pytest.raises(ValueError, match="no place for the table"):
        write_table(page, BEGIN, "a table")
    assert page.read_text() == f"a page with {END}"


def test_what_is_there_is_not_measured_again(tmp_path, monkeypatch):
    options = Options(
        scenarios=("standstill",), filters=("mine",), runs=50, seed=3,
        out=tmp_path / "found.json", docs=tmp_path / "page.md",
    )  # fmt: skip
    options.docs.write_text(f"{BEGIN}\n{END}\n")
    options.out.write_text(json.dumps({"standstill": {"mine": found()}}))
    monkeypatch.setattr(benchmark, "measure", lambda *_: found(runs=51, seed=3))
    main(options)
    assert "50 (seed 3)" in options.docs.read_text()
    main(replace(options, runs=51))
    assert "51 (seed 3)" in options.docs.read_text()
