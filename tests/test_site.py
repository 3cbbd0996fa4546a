"""The pages hang together: each is in the site, each link goes somewhere, versions agree."""

import ast
import json
import re
import sys
import tomllib
from datetime import date
from pathlib import Path

import jupytext
import pytest
from test_house import ORDER

import jaxslam

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs").glob("*.md"))
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.py"))
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *PAGES]


def anchors(path: Path) -> set[str]:
    """What headings of a page are called in links."""
    titles = re.findall(r"^#+ (.*)$", path.read_text(), re.MULTILINE)
    kept = (re.sub(r"[^\w\- ]", "", title.lower().replace("`", "")) for title in titles)
    return {title.strip().replace(" ", "-") for title in kept}


def broken(path: Path) -> list[str]:
    """Links and pictures of a document that lead nowhere in the repository."""
    wrong = []
    text = re.sub(r"```.*?```", "", path.read_text(), flags=re.S)
    for link in re.findall(r"""(?:\]\(|src=")([^)"\s]+)[)"]""", text):
        place, _, anchor = link.partition("#")
        target = (path.parent / place).resolve() if place else path
        if "://" in link or place.startswith("tutorials/"):
            continue
        if not target.exists() or (anchor and anchor not in anchors(target)):
            wrong.append(link)
    return wrong


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_to_what_is_there(document):
    assert not broken(document)


def test_a_link_that_leads_nowhere_is_found(tmp_path):
    (tmp_path / "a.md").write_text(
        '# One, two\n[x](b.md) [y](#one-two) [z](#three) [w](a.md#one-two) <img src="c.png">'
    )
    assert broken(tmp_path / "a.md") == ["b.md", "#three", "c.png"]


def test_every_page_and_notebook_is_in_the_site():
    listed = set((ROOT / "docs" / "index.md").read_text().split())
    assert {page.stem for page in PAGES} - {"index"} <= listed
    assert {f"tutorials/{path.stem}" for path in NOTEBOOKS} <= listed


@pytest.mark.parametrize("source", NOTEBOOKS, ids=lambda path: path.stem)
def test_an_executed_notebook_is_its_source_with_outputs_and_no_warning(source):
    cells = json.loads(source.with_suffix(".ipynb").read_text())["cells"]
    told = [("".join(cell["source"]), cell["cell_type"]) for cell in cells]
    assert told == [(cell.source, cell.cell_type) for cell in jupytext.read(source).cells]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell["outputs"]]
    assert not [x for x in outputs if x["output_type"] == "error" or x.get("name") == "stderr"]


def test_every_room_is_in_the_site():
    """In another order than that of imports: what users meet first comes first."""
    sources = ast.parse((ROOT / "docs" / "site_sources.py").read_text()).body
    (listed,) = [x.value for x in sources if isinstance(x, ast.Assign) and _name(x) == "ROOMS"]
    assert sorted(ast.literal_eval(listed)) == sorted(set(ORDER) - {"_version"})


def _name(assignment: ast.Assign) -> str | None:
    target = assignment.targets[0]
    return target.id if isinstance(target, ast.Name) else None


def test_the_version_is_one():
    """It is in `_version.py`, where the build reads it; the citation has it, with the day of the
    release, and so has the changelog, whose first heading before that says *unreleased*."""
    pyproject = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert pyproject["project"]["dynamic"] == ["version"]
    assert pyproject["tool"]["hatch"]["version"]["path"] == "jaxslam/_version.py"
    cited = dict(re.findall(r"^([\w-]+): (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE))
    assert cited["version"] == jaxslam.__version__
    number, _, prepared = jaxslam.__version__.partition(".dev")
    assert ("date-released" in cited) == (not prepared)
    day = "unreleased" if prepared else str(date.fromisoformat(cited["date-released"]))
    headings = re.findall(r"^## (.+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert headings[0] == f"{number} ({day})"
    assert not any("unreleased" in heading.lower() for heading in headings[1:])


def test_every_public_name_is_documented():
    for name in set(jaxslam.__all__) - {"__version__"}:
        value = getattr(jaxslam, name)
        assert value.__doc__, name


def test_the_workflow_calls_what_runs_here():
    workflow = (ROOT / ".github" / "workflows" / "ci.yml").read_text()
    assert {line.split()[2] for line in workflow.splitlines() if "- run:" in line} == {".ci/run"}
    assert (ROOT / ".ci" / "run").stat().st_mode & 0o100


def installed_by(extra: str, project: dict) -> set[str]:
    """Distributions that the project names, alone or with an extra, those of other extras too."""
    found = set()
    for named in [*project["dependencies"], *project["optional-dependencies"][extra]]:
        match = re.match(r"([\w-]+)(?:\[([\w,]+)\])?", named)
        assert match is not None
        name, extras = match.groups()
        found.add(name)
        for other in extras.split(",") if extras else ():
            found |= installed_by(other, project)
    return found


def imported(tree: ast.AST, *, anywhere: bool) -> set[str]:
    """The packages that a module imports when it is, or anywhere in it."""
    needed = set()
    for node in ast.walk(tree) if anywhere else ast.iter_child_nodes(tree):
        if isinstance(node, ast.ImportFrom):
            needed.add(str(node.module).partition(".")[0])
        elif isinstance(node, ast.Import):
            needed |= {alias.name.partition(".")[0] for alias in node.names}
    return needed - set(sys.stdlib_module_names)


CALLED = {"opencv-python-headless": "cv2", "pyyaml": "yaml", "rerun-sdk": "rerun"}
# `distributed` brings the first; Python 3.14 has the second, and who lacks it is told of the third.
ELSEWHERE = {"cloudpickle", "compression", "backports", "jaxslam"}


@pytest.mark.parametrize(("extras", "anywhere"), [(("docs",), False), (("user",), True)])
def test_extras_bring_what_is_imported(extras, anywhere):
    """The site's all modules, whose pages it makes; those of users also what is imported late."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    if extras == ("user",):
        extras = set(project["optional-dependencies"]) - {"docs", "notebooks", "test"}
    known = {CALLED.get(x, x) for extra in extras for x in installed_by(extra, project)}
    needed = set()
    for path in (ROOT / "jaxslam").rglob("*.py"):
        needed |= imported(ast.parse(path.read_text()), anywhere=anywhere)
    assert needed <= known | ELSEWHERE
