"""Batches of a pure function as a program in C++, its runs on the last axis; see `batch`."""

from jaxslam.native.batch import NotSupportedError, batched

__all__ = ["NotSupportedError", "batched"]
