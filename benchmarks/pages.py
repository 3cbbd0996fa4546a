"""Pages with tables that a benchmark writes: each between two marks."""

from __future__ import annotations

from pathlib import Path

from jaxslam._runtime.files import write_atomically

END = "<!-- end -->"


def write_table(page: Path, begin: str, table: str) -> None:
    """Put the table after its mark on the page, in place of an older one.

    Raises ValueError where the page has no such place.
    """
    before, mark, rest = page.read_text().partition(begin)
    _, end, after = rest.partition(END)
    if not mark or not end:
        raise ValueError(f"the page has no place for the table: {begin} … {END}")
    with write_atomically(page) as path:
        path.write_text(f"{before}{begin}\n\n{table}\n\n{END}{after}")
