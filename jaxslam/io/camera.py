"""A live camera: `0` is the first that the system has."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Condition, Thread

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
        with opened(self.number) as capture:
            begun = time.monotonic()
            newest = _Newest(capture.read)
            try:
                while True:
                    came, image = newest.wait(self.number)
                    self._came = came - begun
                    yield as_grey(image)
            finally:
                newest.stop()


class _Newest:
    """The newest picture that is read, taken once."""

    def __init__(self, read: Callable[[], tuple[bool, np.ndarray | None]]) -> None:
        self._changed = Condition()
        self._picture: tuple[float, np.ndarray] | None = None
        self._running = True
        self._thread = Thread(target=self._fetch, args=(read,), daemon=True)
        self._thread.start()

    def wait(self, number: int) -> tuple[float, np.ndarray]:
        with self._changed:
            self._changed.wait_for(lambda: self._picture or not self._running, PATIENCE)
            picture, self._picture = self._picture, None
        if picture is None:
            raise ValueError(f"camera {number} delivers no pictures")
        return picture

    def stop(self) -> None:
        self._running = False
        self._thread.join(PATIENCE)

    def _fetch(self, read: Callable[[], tuple[bool, np.ndarray | None]]) -> None:
        while self._running:
            found, image = read()
            with self._changed:
                if image is not None and found:
                    self._picture = time.monotonic(), image
                else:
                    self._running = False
                self._changed.notify()


def _open(path: Path, _rate: float) -> Recording:
    live = Live(int(str(path)))
    return Recording(f"camera {live.number}", np.zeros(0), live.images, clock=live.clock)


CAMERA = Layout(
    "the number of a camera (0)", lambda x: str(x).isdecimal() and not x.exists(), _open
)
