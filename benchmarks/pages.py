"""Pages with tables that a benchmark writes: each between two marks."""

from __future__ import annotations

END = "<!-- end -->"


def with_table(text: str, begin: str, table: str) -> str:
    """The page with the table after its mark, in place of an older one.

    Raises ValueError where the page has no such place.
    """
    before, mark, rest = text.partition(begin)
    _, end, after = rest.partition(END)
    if not mark or not end:
        raise ValueError(f"the page has no place for the table: {begin} … {END}")
    return f"{before}{begin}\n\n{table}\n\n{END}{after}"
