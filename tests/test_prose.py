"""The pages are in plain English, as far as that can be checked."""

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.py"))

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
