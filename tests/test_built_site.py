"""The built site: no page scrolls sideways, no link is broken.

`JAXSLAM_SITE=site python -m pytest -n0 tests/test_built_site.py`, after `sphinx-build docs site`.
Widths are measured by headless Chromium, where there is one.
"""

import html
import json
import os
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest

SITE = Path(os.environ.get("JAXSLAM_SITE") or "/nowhere")
BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
WIDTHS = (1280, 390)
"""Pixels of a laptop's window and of a phone."""

pytestmark = pytest.mark.skipif(not SITE.is_dir(), reason="JAXSLAM_SITE names no built site")
needs_browser = pytest.mark.skipif(BROWSER is None, reason="Chromium is not installed")

PROBE = """<!doctype html><meta charset="utf-8"><body><pre id="out"></pre><script>
const pages = %s, widths = %s;
(async () => {
  const found = [];
  for (const width of widths) for (const page of pages) {
    const frame = document.createElement("iframe");
    frame.style.cssText = `width:${width}px;height:800px;border:0`;
    frame.src = page;
    await new Promise(done => { frame.onload = done; document.body.append(frame); });
    await new Promise(done => setTimeout(done, 30));
    const root = frame.contentDocument.documentElement;
    const tables = [...root.querySelectorAll("article .table-wrapper")].filter(
      box => box.scrollWidth > box.clientWidth + 1).map(box => box.scrollWidth);
    found.push({page, width, wide: root.scrollWidth, tables});
    frame.remove();
  }
  document.getElementById("out").textContent = "FOUND" + JSON.stringify(found) + "END";
})();
</script>"""


def pages() -> list[Path]:
    """Those that people read: sources of modules are as wide as they are."""
    found = (p for p in SITE.rglob("*.html") if not p.relative_to(SITE).parts[0].startswith("_"))
    return sorted(found)


@pytest.fixture(scope="module")
def measured(tmp_path_factory) -> list[dict]:
    """Of every page at every width: how wide it is, and the tables that are wider than the text."""
    assert BROWSER is not None
    probe = tmp_path_factory.mktemp("probe") / "probe.html"
    probe.write_text(PROBE % (json.dumps([p.resolve().as_uri() for p in pages()]), list(WIDTHS)))
    options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--allow-file-access-from-files"]
    options += ["--disable-web-security", "--window-size=1400,900", "--virtual-time-budget=300000"]
    profile = f"--user-data-dir={probe.parent / 'profile'}"
    done = subprocess.run(
        [BROWSER, *options, profile, "--dump-dom", probe.as_uri()],
        capture_output=True, text=True, timeout=500,
    )  # fmt: skip
    match = re.search("FOUND(.*?)END<", done.stdout, re.DOTALL)
    assert match is not None, done.stderr[-2000:]
    return json.loads(html.unescape(match[1]))


@needs_browser
def test_no_page_scrolls_sideways(measured):
    assert len(measured) == len(WIDTHS) * len(pages()) > 0
    assert not [(x["page"], x["width"], x["wide"]) for x in measured if x["wide"] > x["width"]]


@needs_browser
def test_tables_fit_the_text_on_a_laptop(measured):
    laptop = (x for x in measured if x["width"] == WIDTHS[0])
    assert not {Path(x["page"]).name: x["tables"] for x in laptop if x["tables"]}


class Read(HTMLParser):
    """The links, anchors and tables of a page."""

    def __init__(self, path: Path):
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.open: list[str] = []
        self.bare_tables = 0
        self.feed(path.read_text())

    def handle_starttag(self, tag, attrs):
        given = {key: value or "" for key, value in attrs}
        self.anchors.add(given.get("id", ""))
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        if tag == "div":
            self.open.append(given.get("class", ""))
        if tag == "table" and "docutils" in given.get("class", ""):
            self.bare_tables += not any("table-wrapper" in name for name in self.open)

    def handle_endtag(self, tag):
        if tag == "div" and self.open:
            self.open.pop()


def test_links_of_the_site_lead_somewhere():
    read = {path.resolve(): Read(path) for path in pages()}
    broken = []
    for path, page in read.items():
        for link in page.links:
            place, _, anchor = unquote(link).partition("#")
            if re.match(r"\w+:", place):
                continue
            target = (path.parent / place).resolve() if place else path
            found = target.exists() and (
                target not in read or not anchor or anchor in read[target].anchors
            )
            if not found:
                broken.append((path.name, link))
    assert not broken


def test_tables_scroll_in_a_box_of_their_own():
    assert not {path.name: n for path in pages() if (n := Read(path).bare_tables)}
    css = (SITE / "_static/site.css").read_text()
    assert re.search(r"pre, \.table-wrapper.*overflow-x: auto", css)
