"""The figure of docs/evaluate.md: what its first snippet prints, drawn.

`python benchmarks/evaluation_figure.py` runs the snippet and writes `docs/evaluate.png`.
"""

from __future__ import annotations

import contextlib
import re
import tempfile
from pathlib import Path
from typing import Any

import tyro

from jaxslam.evaluation import Evaluation
from jaxslam.plots.evaluation import plot_evaluation


def evaluation_of(page: str) -> Evaluation:
    """What the first snippet of a page calls `found`; its files go nowhere."""
    (snippet, *_) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    names: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        exec(compile(snippet, "evaluate.md", "exec"), names)
    return names["found"]


def main(docs: Path = Path("docs")) -> None:
    """Draw what the first snippet of evaluate.md finds, in a folder of pages."""
    found = evaluation_of((docs / "evaluate.md").read_text())
    plot_evaluation(found, docs / "evaluate.png")


if __name__ == "__main__":
    tyro.cli(main)
