"""A live camera: `0` is the first that the system has."""

import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from threading import Condition, Event, Thread

import numpy as np

from jaxslam.io.file import opened
from jaxslam.io.pictures import as_grey
from jaxslam.io.recording import Layout, Recording
from jaxslam.io.source import Image

PATIENCE = 5.0
"""Seconds in which a camera must deliver a picture."""


class Live:
    """The newest picture of a camera, and when it came: seconds after it was opened.

    A thread of its own fetches them, so that what a slow reader skips does not wait in a queue.
    """

    def __init__(self, number: int) -> None:
        self.number = number
        self._came = 0.0

    def clock(self) -> float:
        """The time of the picture that `images` gave last, s."""
        return self._came

    def images(self) -> Iterator[Image]:
        """Pictures as they come. Raises ValueError where none comes for `PATIENCE` seconds."""
        changed, over = Condition(), Event()
        newest: deque[tuple[float, np.ndarray]] = deque(maxlen=1)

        with opened(self.number) as capture:

            def fetch() -> None:
                while not over.is_set():
                    found, image = capture.read()
                    with changed:
                        if found and image is not None:
                            newest.append((time.monotonic(), image))
                        else:
                            over.set()
                        changed.notify()

            begun = time.monotonic()
            thread = Thread(target=fetch, daemon=True)
            thread.start()
            try:
                while True:
                    with changed:
                        changed.wait_for(lambda: newest or over.is_set(), PATIENCE)
                        if not newest:
                            raise ValueError(f"camera {self.number} delivers no pictures")
                        came, image = newest.pop()
                    self._came = came - begun
                    yield as_grey(image)
            finally:
                over.set()
                thread.join(PATIENCE)


def _open(path: Path, _rate: float) -> Recording:
    live = Live(int(str(path)))
    return Recording(f"camera {live.number}", np.zeros(0), live.images, clock=live.clock)


CAMERA = Layout(
    "the number of a camera (0)", lambda x: str(x).isdecimal() and not x.exists(), _open
)
