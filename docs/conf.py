"""The site: `sphinx-build -W docs site`. Pages are Markdown, the API is the docstrings."""

import importlib.util
import os
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent), str(HERE)]
os.environ.setdefault("JAX_PLATFORMS", "cpu")  # signatures show arrays: none is put on a device

import site_sources  # noqa: E402

import jaxslam  # noqa: E402

project, author, release = "jaxslam", "the authors of jaxslam", jaxslam.__version__
project_copyright = "the authors of jaxslam, Apache-2.0"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.mathjax"]
if not tags.has("without_sources"):  # .ci/run: to highlight every source takes as long as the rest
    extensions.append("sphinx.ext.viewcode")
html_theme, html_title = "furo", f"jaxslam {release}"
html_copy_source = False
html_static_path = html_css_files = ["site.css"]

# Notebooks are executed before they are committed, and again, short, by .ci/run.
nb_execution_mode = "off"
nb_merge_streams = True  # a table that was printed line by line is one
myst_enable_extensions = ["dollarmath", "deflist", "colon_fence"]
myst_heading_anchors = 3
suppress_warnings = [
    "myst.header",  # pages of results begin their sections where they like
]

autodoc_member_order, autodoc_preserve_defaults = "bysource", True
autodoc_inherit_docstrings = False  # those of other packages are not written like ours
autodoc_default_options = {"members": True, "no-value": True, "show-inheritance": True}
autodoc_mock_imports = [name for name in ("cv2", "rerun") if importlib.util.find_spec(name) is None]

site_sources.write_tutorials(HERE.parent / "notebooks", HERE / "tutorials")
site_sources.write_api(HERE / "api")


def setup(app):
    app.connect("source-read", site_sources.with_links_of_the_site)
    app.connect("autodoc-process-docstring", site_sources.docstring_as_rst)
    app.connect("autodoc-skip-member", site_sources.skipped)
