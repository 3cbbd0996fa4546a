"""The video file of the overlay, whole at any end, and the thread on which it is drawn."""

import os
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

WAITING = 8
"""The most frames that may wait to be drawn; beyond it the tracker waits, so memory is bounded."""


class Aside:
    """Does what is `given` to it in order on a thread of its own, all of it by the block's end.

    An exception there is raised here, by a later `give` or at the end; what was given after it may
    be left undone. No more than `WAITING` wait: then `give` does.
    """

    def __enter__(self) -> "Aside":
        self._thread = ThreadPoolExecutor(1, "aside")
        self._waiting: deque[Future[object]] = deque()
        return self

    def give(self, function: Callable[..., object], *arguments: object) -> None:
        """Queue `function(*arguments)`."""
        while self._waiting and (len(self._waiting) >= WAITING or self._waiting[0].done()):
            self._waiting.popleft().result()
        self._waiting.append(self._thread.submit(function, *arguments))

    def __exit__(self, *raised: object) -> None:
        try:
            for done in self._waiting:
                done.result()
        finally:
            self._thread.shutdown(cancel_futures=True)


class OverlayWriter:
    """An MP4 file written frame by frame, complete at any end of the `with` block.

    Frames go to a temporary name beside `path`, which becomes `path` when the block ends, by an
    exception or an interruption too, but for one after the first. `size` is width and height in
    pixels of the frames to come (MP4 drops the last row or column of an odd one), `rate` in 1/s.
    Raises `ValueError` where the file cannot be opened or a frame has another size.
    """

    def __init__(self, path: str | Path, size: tuple[int, int], rate: float) -> None:
        self.path = Path(path)
        self.size = size
        self.rate = rate
        self.frames = 0
        if self.path.suffix.lower() != ".mp4":
            raise ValueError(f"{self.path}: the name must end in .mp4")
        self._temporary = self.path.with_name(f".{os.getpid()}.{self.path.name}")

    def __enter__(self) -> "OverlayWriter":
        fourcc = cv2.VideoWriter.fourcc(*"mp4v")
        self._writer = cv2.VideoWriter(str(self._temporary), fourcc, self.rate, self.size)
        if not self._writer.isOpened():
            self._temporary.unlink(missing_ok=True)
            raise ValueError(
                f"{self.path}: cannot be opened as an MP4 video of {self.size[0]}x{self.size[1]} "
                f"at {self.rate} frames/s"
            )
        return self

    def write(self, frame: UInt8[np.ndarray, "h w 3"]) -> None:
        """Append a frame, as `draw_overlay` returns it."""
        if frame.shape != (self.size[1], self.size[0], 3):  # OpenCV would drop it silently
            raise ValueError(
                f"{self.path}: a frame of shape {frame.shape} does not fit a video of "
                f"{self.size[0]}x{self.size[1]} in colour"
            )
        self._writer.write(frame)
        self.frames += 1

    def __exit__(self, *raised: object) -> None:
        self._writer.release()
        if self.frames > (KeyboardInterrupt in raised):
            self._temporary.replace(self.path)
        else:
            self._temporary.unlink(missing_ok=True)
