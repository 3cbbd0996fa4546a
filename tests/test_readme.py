"""The README's library example runs, and its commands are those of the command line."""

import re
from pathlib import Path

README = (Path(__file__).parents[1] / "README.md").read_text()


def test_the_library_example_runs_and_prints_a_table(capsys):
    (snippet,) = re.findall(r"<!-- runs as a test -->\n```python\n(.*?)```", README, re.DOTALL)
    assert len(snippet.strip().splitlines()) <= 13
    exec(compile(snippet, "README.md", "exec"), {})
    assert "robocentric/inverse_scaling" in capsys.readouterr().out
