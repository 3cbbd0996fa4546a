"""The paper beside the code: its filter in NumPy, and the page that maps one to the other."""

import ast
import re
import runpy
from pathlib import Path

import pytest

import jaxslam

ROOT = Path(__file__).parents[1]
NOTEBOOK = ROOT / "notebooks" / "paper_in_numpy.py"
EQUATIONS = r"P\d+(?:–P\d+)?(?:, P\d+(?:–P\d+)?)*"
PAGE = (ROOT / "docs" / "paper.md").read_text()


def numbered(text: str) -> set[int]:
    """The numbers of all equations that a text names: `P18–P21` are four."""
    found: set[int] = set()
    for first, last in re.findall(r"\bP(\d+)(?:–P(\d+))?\b", text):
        found |= set(range(int(first), int(last or first) + 1))
    return found


def in_docstrings(path: Path) -> set[int]:
    """Equations of the paper that a file names, in brackets or at the start of a docstring."""
    found = re.findall(rf"\((?:\w+ of )?({EQUATIONS})\)|of ({EQUATIONS})\)", path.read_text())
    opening = re.findall(rf'"""({EQUATIONS})[.:]', path.read_text())
    return numbered(" ".join([*(a or b for a, b in found), *opening]))


def section(title: str) -> list[list[str]]:
    """Rows of the table under a heading of the page, without its head."""
    text = PAGE.split(f"## {title}\n")[1].split("\n## ")[0]
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]
    return rows[2:]


def definitions(path: Path) -> set[str]:
    """Names that a file defines: functions, constants, classes and `Class.method`."""
    names = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        if isinstance(node, ast.ClassDef):
            names |= {f"{node.name}.{n.name}" for n in node.body if isinstance(n, ast.FunctionDef)}
        if isinstance(node, ast.Assign):
            names |= {t.id for t in node.targets if isinstance(t, ast.Name)}
    return names


@pytest.mark.slow
def test_the_papers_filter_in_numpy_is_the_librarys():
    """Frame by frame, where landmarks come and go and where the filter breaks."""
    results = runpy.run_path(str(NOTEBOOK))["results"]
    assert set(results) == {"circle", "matched-loose"}
    for name, (differences, poses) in results.items():
        assert len(differences) == len(poses) + 1 >= 61, name
        assert differences.max() < 1e-9, name
        assert poses[-1, 1] > 1e-3, name


def test_it_has_at_most_eighty_lines_and_nothing_of_the_library():
    cell = NOTEBOOK.read_text().split('# %% tags=["filter"]\n')[1].split("\n# %%")[0]
    assert len(cell.strip().splitlines()) <= 80
    assert not re.search(r"jax|grad|eps\b", cell)


def test_every_function_that_the_page_names_is_there():
    count = 0
    for _, _, functions, _ in section("From the paper to the code"):
        for part in functions.split("; "):
            path, _, names = part.partition(": ")
            known = definitions(ROOT / "jaxslam" / path.strip("`"))
            for name in re.findall(r"`([\w.]+)`", names):
                assert name in known, f"{path} has no {name}"
                count += 1
    assert count > 20


def test_the_code_names_the_equations_that_the_page_says():
    """Both ways: no file is left out, and none is named for an equation that it does not have."""
    page = {path.strip("`"): numbered(equations) for path, equations in section(
        "From the code to the paper"
    )}  # fmt: skip
    package = Path(jaxslam.__file__).parent
    code = {
        str(path.relative_to(package)): in_docstrings(path)
        for path in sorted(package.rglob("*.py"))
    }
    assert page == {path: equations for path, equations in code.items() if equations}


def test_every_equation_of_the_code_has_a_row():
    rows = numbered(" ".join(row[0] for row in section("From the paper to the code")))
    named = numbered(" ".join(row[1] for row in section("From the code to the paper")))
    assert rows == named


def test_every_notebook_is_on_the_page():
    for notebook in (ROOT / "notebooks").glob("*.py"):
        assert f"notebooks/{notebook.name}" in PAGE
