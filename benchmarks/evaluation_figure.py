"""The figure of docs/evaluate.md: what its first snippet prints, drawn.

`python benchmarks/evaluation_figure.py` runs the snippet and writes `docs/evaluate.png`.
"""

from __future__ import annotations

import contextlib
import re
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from jaxslam.evaluation import Evaluation
from jaxslam.plots.evaluation import plot_evaluation


@dataclass(frozen=True)
class Options:
    """Where the page is."""

    docs: Path = Path("docs")
    """Folder of evaluate.md and evaluate.png."""


def evaluation_of(page: str) -> Evaluation:
    """What the first snippet of a page calls `found`; its files go nowhere."""
    (snippet, *_) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    names: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        exec(compile(snippet, "evaluate.md", "exec"), names)
    return names["found"]


def main(options: Options) -> None:
    """Run the snippet, draw what it found."""
    found = evaluation_of((options.docs / "evaluate.md").read_text())
    plot_evaluation(found, options.docs / "evaluate.png")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
