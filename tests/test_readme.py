"""The examples of the README and of the documents run."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]


def run_example(document: str) -> str:
    """Execute the document's one marked snippet and return its text."""
    text = (ROOT / document).read_text()
    (snippet,) = re.findall(r"<!-- runs as a test -->\n```python\n(.*?)```", text, re.DOTALL)
    exec(compile(snippet, document, "exec"), {"__name__": __name__})
    return snippet


def test_the_library_example_runs_and_prints_a_table(capsys):
    snippet = run_example("README.md")
    assert len(snippet.strip().splitlines()) <= 13
    assert "robocentric/inverse_scaling" in capsys.readouterr().out


def test_a_filter_of_ones_own_takes_part_in_a_study(capsys):
    run_example("docs/own-filter.md")
    lines = capsys.readouterr().out.splitlines()
    assert ": consistent (p = " in lines[lines.index("mine:") + 1]
