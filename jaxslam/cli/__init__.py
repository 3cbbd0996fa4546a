"""The command line: a thin layer over the library, one file a command."""

from __future__ import annotations

import signal
import sys
import textwrap
from typing import Annotated

import tyro

from jaxslam._version import __version__
from jaxslam.cli.cache import keep_programs
from jaxslam.cli.calibrate import CalibrateOptions
from jaxslam.cli.consistency import ConsistencyOptions
from jaxslam.cli.evaluate import EvaluateOptions
from jaxslam.cli.track import TrackOptions
from jaxslam.cli.triangulate import TriangulateOptions

Command = (
    Annotated[
        ConsistencyOptions,
        tyro.conf.subcommand(
            "consistency", description="Simulate many runs of filters: are they consistent?"
        ),
    ]
    | Annotated[
        EvaluateOptions,
        tyro.conf.subcommand(
            "evaluate", description="Errors and covariances of your own filter: is it consistent?"
        ),
    ]
    | Annotated[
        TrackOptions,
        tyro.conf.subcommand(
            "track", description="Track a camera through a video: trajectory, map, overlay."
        ),
    ]
    | Annotated[
        CalibrateOptions,
        tyro.conf.subcommand(
            "calibrate", description="Film a board: the camera's calibration, and how sure it is."
        ),
    ]
    | Annotated[
        TriangulateOptions,
        tyro.conf.subcommand(
            "triangulate", description="A point seen twice: what is known of its depth, and is it?"
        ),
    ]
)


def main(arguments: list[str] | None = None) -> None:
    """Run a command. A mistake of the user's ends with exit status 2 and one line."""
    given = sys.argv[1:] if arguments is None else arguments
    if given == ["--version"]:
        print(f"jaxslam {__version__}")
        return
    options = tyro.cli(
        Command,
        args=given,
        prog="jaxslam",
        description="Monocular EKF-SLAM whose uncertainty can be believed. --version says which.",
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.HelptextFromCommentsOff),
    )
    signal.signal(signal.SIGTERM, _interrupt)
    keep_programs()
    try:
        options.run()
    except ValueError as error:
        _fail(2, str(error))
    except OSError as error:  # a path that is too long, a folder that may not be written
        _fail(2, f"{textwrap.shorten(str(error.filename), 80)}: {error.strerror or error}")
    except KeyboardInterrupt as interrupt:
        _fail(130, f"interrupted{f': {interrupt}' if str(interrupt) else ''}")


def _interrupt(*_) -> None:
    raise KeyboardInterrupt


def _fail(status: int, message: str) -> None:
    print(f"jaxslam: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(status)
