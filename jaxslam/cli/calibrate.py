"""`jaxslam calibrate`: a camera's calibration from a video of a board."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from jaxslam._runtime.files import write_atomically
from jaxslam.cli.extra import one_line_warnings, require_vision


@dataclass(frozen=True)
class CalibrateOptions:
    """Calibrate a camera, with uncertainty, from a video of a board."""

    board_video: Annotated[
        Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="BOARD_VIDEO")
    ] = None
    """Video or folder of images of a board held still and tilted in all directions. Default: draw
    the board, for printing."""
    board: str = "checkerboard"
    """Kind of board: checkerboard or charuco."""
    columns: int = 10
    """Number of squares across; 10 squares have 9 inner corners."""
    rows: int = 7
    """Number of squares down."""
    square: float = 0.025
    """Side of a square in metres; the intrinsics do not depend on it."""
    dictionary: str = "5X5_100"
    """Marker dictionary of a charuco board; a marker's side is 3/4 of a square."""
    out: Path = Path("results")
    """Output folder for calibration.json and coverage.png, or for board.png."""

    def run(self) -> None:
        """Calibrate, print the numbers, write the files; or draw the board."""
        require_vision("calibrating")
        import cv2

        from jaxslam._runtime.progress import bar
        from jaxslam.io.board import Board
        from jaxslam.io.calibrate import calibrate, describe, write

        board = Board(self.board, self.columns, self.rows, self.square, self.dictionary)
        if self.board_video is None:
            self.out.mkdir(parents=True, exist_ok=True)
            with write_atomically(self.out / "board.png") as path:
                cv2.imwrite(str(path), board.drawn())
            print(f"wrote {self.out / 'board.png'}: print it and measure a square")
            return
        with one_line_warnings(), bar(None, "picture") as shown:
            calibrated = calibrate(self.board_video, board, shown.update)
        write(calibrated, board, self.out)
        print(describe(calibrated))
        print(f"wrote calibration.json and coverage.png to {self.out}")
