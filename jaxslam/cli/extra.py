"""What commands share: imports of pictures, one-line warnings, times with a unit."""

from __future__ import annotations

import math
import os
import re
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


def seconds(option: str, time: str) -> float:
    """The seconds of a time with a unit, or of a number. Raises ValueError, naming the option."""
    found = re.fullmatch(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)\s*(s|ms|us|µs|)\s*", time)
    units = {"": 1.0, "s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6}
    value = math.inf if found is None else float(found[1]) * units[found[2]]
    if not abs(value) < math.inf:
        raise ValueError(f"{option} is a time such as 20ms or 0.02s, not {time!r}")
    return value
