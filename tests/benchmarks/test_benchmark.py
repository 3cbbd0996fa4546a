"""Tests of the base of all benchmarks: files, pages, the command line."""

import json
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest
import verdicts
from benchmark import END, Benchmark, by_batch, number, run_one, table

MARK = "<!-- counted -->"


@dataclass(frozen=True, kw_only=True)
class Counted(Benchmark):
    """Counts on from what is there."""

    to: int = 2
    out: Path = Path("counted.json")

    def measure(self):
        done = self.found().get("done", [])
        while len(done) < self.to:
            done.append(len(done))
            yield {"done": done}
        if self.to > 3:
            raise ValueError("too far")

    def tables(self, results):
        yield "page.md", MARK, table(("i", "i²"), [(i, i**2) for i in results["done"]])


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "page.md").write_text(f"before\n{MARK}\n\nold\n\n{END}\nafter\n")
    return tmp_path


def test_results_are_added_to_and_their_table_takes_the_place_of_the_old_one(folder):
    for to in (1, 3):
        Counted(to=to, out=folder / "results" / "counted.json", docs=folder)()
    assert json.loads((folder / "results" / "counted.json").read_text()) == {"done": [0, 1, 2]}
    rows = "| i | i² |\n|---|---|\n| 0 | 0 |\n| 1 | 1 |\n| 2 | 4 |"
    assert (folder / "page.md").read_text() == f"before\n{MARK}\n\n{rows}\n\n{END}\nafter\n"


def test_what_is_there_is_not_measured_again_but_of_other_numbers_of_runs(folder):
    study, asked = Counted(out=folder / "x.json"), []

    def measure(name):
        asked.append(name)
        return {"of": name}

    def cases(runs):
        for name in "ab":
            yield ("where", name), {"runs": runs}, partial(measure, name)

    assert [len(results["where"]) for results in study.added(cases(3))] == [1, 2]
    for results in study.added(cases(3)):
        study.save(results)
    asked.clear()
    assert not list(study.added(cases(3)))
    assert not asked
    *_, found = study.added(cases(4))
    assert asked == ["a", "b"]
    assert found == {"where": {name: {"runs": 4, "of": name} for name in "ab"}}


def test_records_of_batches_are_those_of_all_runs():
    x = np.arange(14.0).reshape(7, 2)
    found = by_batch(lambda runs: {"twice": 2 * runs, "sum": runs.sum(axis=1)}, x, 3)
    np.testing.assert_array_equal(found["twice"], 2 * x)
    np.testing.assert_array_equal(found["sum"], x.sum(axis=1))


def test_what_was_found_before_an_error_is_kept(folder):
    with pytest.raises(ValueError, match="too far"):
        Counted(to=4, out=folder / "counted.json", docs=folder)()
    assert json.loads((folder / "counted.json").read_text())["done"] == [0, 1, 2, 3]


def test_the_page_alone_is_written_from_what_is_there(folder, monkeypatch):
    out = folder / "counted.json"
    out.write_text('{"done": [0]}')
    monkeypatch.setattr(sys, "argv", ["x", "--page", "--out", str(out), "--docs", str(folder)])
    before = jax.config.values["jax_enable_x64"]
    Counted.run()
    jax.config.update("jax_enable_x64", before)
    assert json.loads(out.read_text()) == {"done": [0]}
    assert "| 0 | 0 |" in (folder / "page.md").read_text()


def test_a_page_without_a_place_and_a_broken_file_are_refused(folder):
    (folder / "page.md").write_text("nothing")
    with pytest.raises(ValueError, match="no place for the table"):
        Counted(out=folder / "counted.json", docs=folder)()
    (folder / "counted.json").write_text("{")
    with pytest.raises(ValueError, match=r"counted\.json: not a JSON file"):
        Counted(out=folder / "counted.json", docs=folder)()


@pytest.mark.parametrize(
    ("value", "said"), [(None, "–"), (float("nan"), "–"), (3.14159, "3.14"), (-12345.0, "-1.2e+04")]
)
def test_numbers_of_a_table_are_short(value, said):
    assert number(value) == said


def test_of_several_benchmarks_in_a_file_the_command_names_one(monkeypatch, tmp_path):
    out = tmp_path / "x.json"
    told = ["verdicts.py", "mistakes", "--studies", "2", "--out", str(out), "--docs", str(tmp_path)]
    monkeypatch.setattr("sys.argv", told)
    monkeypatch.setattr(verdicts.Mistakes, "measure", lambda self: iter([{"of": self.studies}]))
    run_one(verdicts.Verdicts, verdicts.Mistakes)
    assert json.loads(out.read_text()) == {"of": 2}
