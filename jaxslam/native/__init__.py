"""Batches of a pure function as a program in C++, its runs on the last axis; see `batch`."""

from jaxslam.native.batch import NotSupportedError, batched
from jaxslam.native.build import compiler
from jaxslam.native.programs import NativePrograms, difference

__all__ = ["NativePrograms", "NotSupportedError", "batched", "compiler", "difference"]
