"""Tests of benchmarks/sequences.py: pages say what its numbers on disk say."""

import json
from pathlib import Path

import sequences as benchmark
from benchmark import END

FOLDER = Path(__file__).resolve().parents[2]


def on_disk():
    return json.loads((FOLDER / "benchmarks/results/sequences.json").read_text())


def test_the_pages_have_the_numbers_on_disk():
    results = on_disk()
    page = (FOLDER / "docs/sequences.md").read_text()
    for mark, part in benchmark.PARTS.items():
        assert f"{mark}\n\n{part(results)}\n\n{END}" in page
    said = f"{benchmark.MARK}\n\n{benchmark.words(results)}\n\n"
    assert said in (FOLDER / "docs/results.md").read_text()


def test_every_filter_of_the_numbers_has_a_column():
    results = on_disk()
    columns = len(benchmark.errors_table(results).splitlines()[0].split(" | ")) - 2
    assert columns == len(benchmark.SHORT)
    assert max(map(len, results.values())) == columns


def test_a_video_that_was_lost_says_so_beside_its_error():
    found = {"error": 0.5, "path": 10.0, "tracked": 9, "frames": 51, "maps": 3}
    assert benchmark._error(found) == "5.00%; 9 of 51 frames, 3 maps"
    assert benchmark._error(found | {"maps": 1}) == "5.00%"
    assert benchmark._error(found | {"error": None}) == "–"


def test_the_sentences_on_covariances_are_of_the_numbers_on_disk():
    page = " ".join((FOLDER / "docs/results.md").read_text().split())
    own, world = (
        [
            filters[f"{name}/{benchmark.LANDMARKS}"]
            for video, filters in on_disk().items()
            if video.startswith("synthetic")
        ]
        for name in (benchmark.ON_VIDEO, "world")
    )
    means, others = (sorted(r["belief"]["nees"] for r in x) for x in (own, world))
    drifts = sorted(r["belief"]["drift"][1] for r in own)
    assert f"is {means[0]:.2g} to {means[-1]:.2g} of its degrees of freedom" in page
    assert f"`world` has {others[0]:.2g} to {others[-1]:.2g}," in page
    assert f"is {drifts[0]:.2g} to {drifts[-1]:.2g} of its claimed σ" in page
    drift, normalised = on_disk()["costado"][benchmark.OWN]["belief"]["drift"]
    said = f"varies by {drift:.1%} (RMS), {normalised:.2f} of what is claimed"
    assert said.replace("%", " %") in page
