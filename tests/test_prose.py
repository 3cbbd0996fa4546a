"""Pages and docstrings are in plain English, as far as that can be checked."""

import ast
import inspect
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.py"))
FILES = [path for path in (ROOT / "jaxslam").rglob("*.py") if path.name != "_version.py"]
ROOMS = sorted({path.relative_to(ROOT / "jaxslam").parts[0].removesuffix(".py") for path in FILES})

LONGEST = 45
"""Words of a sentence."""
DIALECT = {
    r"told (apart|nothing|of)|tells? nothing|(is|are|was|were|not) told": "given, known; shows",
    r"sets? out\b": "starts",
    r"beyond doubt": "certain",
    r"nobody|somebody|anybody": "name who, or use the passive",
    r"stands? still": "hangs; is at rest",
    r"(is|are|was|were) laid on": "is aligned with",
    r"at the (most|least)": "at most, at least",
    r"give or take": "a factor of",
    r"(made|rendered|drawn) on the spot": "say where",
    r"all the same": "nevertheless",
    r"in silence": "silently",
    r"the very same": "the same",
    r"(one|once) a (run|map|line|page|frame|step|question|pose)": "per",
    r"(is|are|was|were) to be \w+ed": "must be",
    r"begun|mended|by oversight|beware": "started; repaired; by mistake; note",
    r"of one's own|of ones own": "your own",
    r"what (is|was) (it|this) worth": "how well this works",
    r"upon|whilst|thereof|therein|whereof|thereby": "on, while, of it",
    r"apart from each other|far from one another": "apart",
}
"""Words that no technical writer of English uses so, and what to write."""
AMERICAN = (
    r"\b(?=[a-z])(\w+ization|(?:in)?itializ\w+|lineariz\w+|marginaliz\w+|normaliz\w+"
    r"|optimiz\w+|recogniz\w+|summariz\w+|minimiz\w+|maximiz\w+|localiz\w+|behavior\w*|color\w*"
    r"|center\w*|neighbor\w*|labeled|modeled|modeling|gray|meters?|favor\w*|analyze\w*)\b"
)
"""Spellings that would mix with those of the pages: British, but for *parametrization*."""
TITLES = re.compile(r"(?<!\*)\*(?!\*)[^*]{20,}(?<!\*)\*(?!\*)")
"""Of works, which are spelt as their authors did."""

EXCEPTIONS: dict[str, int] = {}
"""Pages that break so many rules at most. This list only becomes shorter, its numbers smaller."""
IN_ROOMS = {"native": 5}
"""Rooms whose docstrings break so many at most. This list too only becomes shorter."""
HALF = re.compile(r"(…|Of |So many |Such |And |Or |But )|.*…$", re.DOTALL)
"""A docstring that is no sentence without the name that it explains, or without the next one."""


def prose(text: str) -> list[str]:
    """Paragraphs, items of lists and headings, without code, tables and generated output."""
    text = re.sub(
        r"```.*?```|<!--.*?-->|\$\$.*?\$\$|\{py:obj\}|^---$.*?^---$", "", text, flags=re.S | re.M
    )
    blocks, found = re.split(r"\n\s*\n|\n(?=\s*[-*] |\s*\d+\. |#|\||: )", text), []
    for block in blocks:
        first = block.strip("\n")
        if not first or first.startswith("    ") or first.lstrip().startswith("|"):
            continue
        words = re.sub(r"^\s*([-*:#]+|\d+\.)\s", "", first)
        words = re.sub(r"!?\[([^]]*)\]\([^)]*\)", r"\1", words)
        words = TITLES.sub("CODE", re.sub(r"`[^`]*`|\$[^$]*\$", "CODE", words))
        found.append(" ".join(words.replace("*", "").split()))
    return found


def sentences(paragraph: str) -> list[str]:
    """A full stop, question or exclamation mark ends one, and so does an abbreviated list."""
    return re.split(r"(?<=[.!?])[)”\"]?\s+(?=[A-Z“\"(])", paragraph)


def broken(text: str) -> list[str]:
    """What is against the rules."""
    wrong = []
    for paragraph in prose(text):
        for sentence in sentences(paragraph):
            count = len(re.findall(r"\w[\w’'-]*", sentence))
            if count > LONGEST:
                wrong.append(f"{count} words: {sentence[:60]} …")
        for words, better in DIALECT.items():
            for match in re.finditer(rf"\b(?:{words})\b", paragraph, re.IGNORECASE):
                wrong.append(
                    f"“{match[0]}” ({better}): … {paragraph[max(match.start() - 30, 0) :][:70]} …"
                )
        for match in re.finditer(AMERICAN, paragraph):
            if "parametrization" not in match[0].lower():
                wrong.append(f"American spelling: {match[0]}")
        for match in re.finditer(r"\b([a-z]+) \1\b", paragraph):
            wrong.append(f"a word twice: {match[0]}")
    return wrong


def written(page: Path) -> str:
    """The Markdown of a page, or of a notebook's cells."""
    text = page.read_text()
    if page.suffix == ".py":
        cells = re.findall(r"^# %% \[markdown\].*?\n((?:#.*\n)+)", text, re.MULTILINE)
        text = "\n".join(re.sub("^# ?", "", cell, flags=re.MULTILINE) for cell in cells)
    return text


@pytest.mark.parametrize("page", [*PAGES, *NOTEBOOKS], ids=lambda path: path.name)
def test_pages_keep_the_rules(page):
    found = broken(written(page))
    assert len(found) <= EXCEPTIONS.get(page.name, 0), "\n".join(["", *found])


def test_a_page_that_breaks_the_rules_is_found():
    """Each of them, and neither code nor tables."""
    assert not broken(
        "One `color` a word.\n\n| told of |\n|---|\n\n```\nnobody\n```\n\n    the the\n"
    )
    for text in (
        "one two " * 23,
        "The filter sets out.",
        "the center",
        "of of it",
        "- a\n- nobody",
    ):
        assert len(broken(text)) == 1, text


def docstrings(path: Path) -> Iterator[tuple[str, str]]:
    """The names in a file that have no underscore before them, with what is said of each."""

    def inside(node: ast.Module | ast.ClassDef, name: str) -> Iterator[tuple[str, str]]:
        yield name, ast.get_docstring(node) or ""
        for child, after in zip(node.body, [*node.body[1:], None], strict=False):
            if isinstance(child, ast.AnnAssign | ast.Assign):
                target = child.target if isinstance(child, ast.AnnAssign) else child.targets[0]
                if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                    yield ast.unparse(target), inspect.cleandoc(str(after.value.value))
            if isinstance(child, ast.FunctionDef):
                yield child.name, ast.get_docstring(child) or ""
            if isinstance(child, ast.ClassDef) and not child.name.startswith("_"):
                yield from inside(child, child.name)

    for name, text in inside(ast.parse(path.read_text()), path.stem):
        if text and (not name.startswith("_") or name.startswith("__")):
            yield name, text


@pytest.mark.parametrize("room", ROOMS)
def test_docstrings_keep_the_rules_of_pages_and_are_whole(room):
    place = ROOT / "jaxslam" / room
    found = [
        f"{path.relative_to(ROOT)}, {name}: {fault}"
        for path in sorted(place.rglob("*.py")) or [place.with_suffix(".py")]
        for name, text in docstrings(path)
        for fault in [*broken(text), *["half of a sentence"] * bool(HALF.match(text))]
    ]
    assert len(found) <= IN_ROOMS.get(room, 0), "\n".join(["", *found])


def test_a_docstring_that_is_half_of_a_sentence_is_found(tmp_path):
    (tmp_path / "a.py").write_text(
        '"""Whole."""\nX = 1\n"""One, …"""\nclass A:\n    """Whole."""\n    y: int = 1\n'
        '    """… and its other half."""\n    def _hidden(self):\n        """Of it."""\n'
    )
    halves = [name for name, text in docstrings(tmp_path / "a.py") if HALF.match(text)]
    assert halves == ["X", "y"]


def test_titles_are_short_and_each_is_of_one_page():
    pages = [*PAGES, *NOTEBOOKS]
    titles = [re.search(r"^# (.*)$", written(page), re.MULTILINE) for page in pages]
    found = [title[1] for title in titles if title]
    assert max(map(len, found)) <= 65
    assert len(set(found) - {"jaxslam"}) == len([t for t in found if t != "jaxslam"])


def test_commands_install_from_a_clone_by_extras_that_there_are():
    """As long as no index has a release; how one is made says what comes after it."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for page in PAGES:
        text = page.read_text()
        if page.name != "CONTRIBUTING.md":
            assert not re.search(r"pip install '?jaxslam", text), page.name
        named = re.findall(r"pip\s+install\s+(?:-e )?'(\.|jaxslam)\[([\w,]+)\](?:==[\d.]+)?'", text)
        for _, extras in named:
            assert set(extras.split(",")) <= set(project["optional-dependencies"]), page.name
