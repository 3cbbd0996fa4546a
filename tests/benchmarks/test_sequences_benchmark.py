"""Tests of benchmarks/sequences.py: pages say what its numbers on disk say."""

import json
from pathlib import Path

import sequences as benchmark

FOLDER = Path(__file__).resolve().parents[2]


def on_disk():
    return json.loads((FOLDER / "benchmarks/results/sequences.json").read_text())


def test_the_pages_have_the_numbers_on_disk():
    results = on_disk()
    own, _, _ = (FOLDER / "docs/sequences.md").read_text().partition(benchmark.RENDERED)
    assert own == benchmark.page(results)
    table = benchmark.summary(results)
    assert f"{benchmark.MARK}\n\n{table}\n\n" in (FOLDER / "docs/results.md").read_text()


def test_the_sentences_on_covariances_are_of_the_numbers_on_disk():
    page = " ".join((FOLDER / "docs/results.md").read_text().split())
    own, world = (
        [filters[f"{name}/{benchmark.LANDMARKS}"] for filters in on_disk().values()]
        for name in (benchmark.ON_VIDEO, "world")
    )
    means, others = (
        sorted(r["beyond_scale"]["mean"] for r in x if r["beyond_scale"]) for x in (own, world)
    )
    drifts = sorted(r["drift"][1] for r in own if r["beyond_scale"])
    assert f"is {means[0]:.2g} to {means[-1]:.2g} of its degrees of freedom" in page
    assert f"`world` has {others[0]:.2g} to {others[-1]:.2g}," in page
    assert f"is {drifts[0]:.2g} to {drifts[-1]:.2g} of its claimed σ" in page
    (drift, normalised), *_ = (r["drift"] for r in own)
    assert 1 / 8 < normalised < 1 / 6
    assert f"strays by {drift:.1%} (RMS), a seventh".replace("%", " %") in page
