"""Where tables of pages were written from before; see `benchmark`."""

from benchmark import END, write_table

__all__ = ["END", "write_table"]
