"""No page is older than the results that its tables and sentences speak of."""

from pathlib import Path

import pytest
from benchmark import END
from calibration import CalibrationStudy
from comparison import Parametrizations
from consistency import Consistency
from from_rest import FromRest
from handheld import Handheld
from noise_or_model import NoiseOrModel
from one_run import OneRunStudy
from pages import MARK, pages, read, rewritten, value_of
from published import Tables
from real_logs import RealLogs
from recorded_loops import RecordedLoops
from rendered import Rendered
from sequences import Sequences
from stress import Disturbances, Endurance, Starts
from submaps import Submaps
from verdicts import Verdicts

from benchmarks.speed.gpu import OnGpu

RESULTS = read(Path("benchmarks/results"))
OF_RESULTS = [page for page in pages() if MARK.search(page.read_text())]
WRITERS = [
    CalibrationStudy, Consistency, Disturbances, Endurance, FromRest, Handheld, NoiseOrModel, OnGpu,
    OneRunStudy, Parametrizations, RealLogs, RecordedLoops, Rendered, Sequences, Starts, Submaps,
    Tables, Verdicts,
]  # fmt: skip
SAID = {
    "the best of all parametrizations": """min(
        f['robocentric/inverse_scaling']['nees'] <= 1.01 * min(x['nees'] for x in f.values())
        for f in comparison['scenarios'].values())""",
    "homogeneous points have the same numbers": """max(
        abs(f['robocentric/unit_homogeneous']['nees']
            / f['robocentric/inverse_scaling']['nees'] - 1)
        for f in comparison['scenarios'].values()) < 0.001""",
    "Unified Inverse Depth is worse, and Cartesian points are lost outside of `circle`": """min(
        f['robocentric/inverse_depth']['nees'] > f['robocentric/inverse_scaling']['nees']
        and (f['robocentric/cartesian']['lost'] > 0.5) is (name != 'circle')
        for name, f in comparison['scenarios'].items())""",
    "a cut begins a second map": """max(
        abs(x['maps'] - 2) for name in ('cut', 'cut_back') for x in disturbances[name]) == 0""",
    "of the starts none is reversed": """min(
        x[2] is None or x[2] > 0 for s in starts.values() for x in s['starts'].values())""",
    "rendered worlds are one map and not reversed": """
        max(filmed('maps')) == 1 and filmed('sign')[0] > 0.99""",
    "a right filter is rarely called inconsistent": """max(
        sum(share for word, share in x['words']['1'].items()
            if word not in ('consistent', 'cannot tell'))
        for x in verdicts['by_factor']) < 0.011""",
    "of 300 runs a σ that is wrong by 1.3 is found, of 100 one by 2": """min(
        sum(share for word, share in x['words'][f].items()
            if word not in ('consistent', 'cannot tell'))
        for x in verdicts['by_factor']
        for f in {300: ('1.3', '0.769'), 100: ('2', '0.5')}.get(x['runs'], ())) > 0.995""",
    "values are marked that are outside our interval": """min(
        x['theirs'] is None or x['within'] == (x['interval95'][0] <= x['theirs']
                                               <= x['interval95'][1])
        for x in published['rows'])""",
    "with an inertial unit the robocentric and the invariant filter are consistent": """min(
        low < 1.05 and high > 0.95
        for name in ('robocentric', 'invariant') for part in ('orientation', 'position')
        for _, low, high in [inertial['udel_gore'][name][part][x] for x in ('first', 'end')])""",
    "seven of twelve trajectories have a median below 0.95": """
        [len(walked('one_scale_median')), sum(x < 0.95 for x in walked('one_scale_median'))]
        == [12, 7]""",
}
"""What pages say in words, and how the results show it."""


@pytest.mark.parametrize("page", OF_RESULTS, ids=lambda page: page.name)
def test_the_numbers_of_a_page_are_those_of_the_results(page):
    old = page.read_text().splitlines()
    new = rewritten(page.read_text(), RESULTS).splitlines()
    stale = [f"{a}\n  should be\n{b}" for a, b in zip(old, new, strict=True) if a != b]
    assert not stale, "\n".join(["`python benchmarks/pages.py` writes:", *stale])


@pytest.mark.parametrize("writer", WRITERS, ids=lambda writer: writer.__name__)
def test_the_tables_of_a_page_are_those_of_the_results(writer):
    """The command is told by `--page` to write them anew."""
    benchmark = writer(page=True)
    tables = list(benchmark.tables(benchmark.found()))
    assert tables
    for page, mark, text in tables:
        written = (benchmark.docs / page).read_text()
        assert f"{mark}\n\n{text}\n\n{END}" in written, (page, mark)


@pytest.mark.parametrize("said", SAID)
def test_what_a_page_says_in_words_is_so(said):
    assert value_of(SAID[said], RESULTS) == [True]


def test_pages_of_measurements_speak_of_results():
    marked = {page.stem for page in OF_RESULTS}
    assert {"README", "which-filter", "results", "rivals", "repairs", "speed"} <= marked
    assert {"from-rest", "handheld", "stress", "submaps", "faq", "calibration"} <= marked


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
