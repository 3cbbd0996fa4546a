"""No page is older than the results that its sentences speak of."""

from pathlib import Path

import published
import pytest
from pages import MARK, pages, read, rewritten

RESULTS = read(Path("benchmarks/results"))
OF_RESULTS = [page for page in pages() if MARK.search(page.read_text())]


@pytest.mark.parametrize("page", OF_RESULTS, ids=lambda page: page.name)
def test_the_numbers_of_a_page_are_those_of_the_results(page):
    old = page.read_text().splitlines()
    new = rewritten(page.read_text(), RESULTS).splitlines()
    stale = [f"{a}\n  should be\n{b}" for a, b in zip(old, new, strict=True) if a != b]
    assert not stale, "\n".join(["`python benchmarks/pages.py` writes:", *stale])


def test_the_table_of_published_values_is_that_of_its_results():
    rows = RESULTS["published"]["rows"]
    assert published.table_of(rows) in Path("docs/rivals.md").read_text()
    for row in (row for row in rows if row["theirs"] is not None):
        assert row["within"] == (row["interval95"][0] <= row["theirs"] <= row["interval95"][1])


def test_pages_of_measurements_speak_of_results():
    """Or are written by a benchmark as a whole: comparison, consistency and calibration."""
    marked = {page.stem for page in OF_RESULTS}
    assert {"README", "which-filter", "results", "rivals", "repairs", "speed"} <= marked
    assert {"from-rest", "handheld", "stress", "submaps", "faq"} <= marked


def test_a_number_is_written_anew_in_its_form():
    results = {"x": {"a": [0.5, 0.0045], "n": 12345, "few": 3}}
    for old, new in (
        ("1.0 and 2<!-- =x['a'] -->", "0.5 and 0<!-- =x['a'] -->"),
        ("9 %, 2.0 %<!-- =x['a'] -->!", "50 %, 0.4 %<!-- =x['a'] -->!"),  # as tables round it
        ("1,000 runs<!-- =x['n'] -->", "12,345 runs<!-- =x['n'] -->"),
        ("[98, 317]<!-- =[x['few'], x['n']] -->", "[3, 12345]<!-- =[x['few'], x['n']] -->"),
        ("Five and 2<!-- =[x['few'], 7] -->", "Three and 7<!-- =[x['few'], 7] -->"),
        ("1<!-- =x['n'] --> 2<!-- =x['few'] -->", "12345<!-- =x['n'] --> 3<!-- =x['few'] -->"),
        ("no mark 1", "no mark 1"),
    ):
        assert rewritten(old, results) == new
        assert rewritten(new, results) == new


@pytest.mark.parametrize("text", ["x<!-- =x['few'] -->", "1<!-- =x['few'] --><!-- =x['few'] -->"])
def test_a_mark_without_its_number_is_refused(text):
    with pytest.raises(ValueError, match=r"1 numbers are needed before <!-- =x"):
        rewritten(text, {"x": {"few": 3}})
