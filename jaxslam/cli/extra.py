"""The imports and the one-line warnings that the commands on pictures share."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Generator
from contextlib import contextmanager

from jaxslam._runtime.extras import missing


def require_vision(what: str) -> None:
    """Raise ValueError unless the vision extra is installed, which `what` needs."""
    # Their own complaints about broken files would come beside our one line.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    try:
        import cv2  # noqa: F401
    except ImportError as error:
        raise missing(f"{what} needs", "vision", error) from None


@contextmanager
def one_line_warnings() -> Generator[None]:
    """Warnings as one line on standard error, as a person at a terminal wants them."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield
    for warning in caught:
        print(f"jaxslam: warning: {warning.message}", file=sys.stderr)
