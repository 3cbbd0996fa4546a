"""The commands and their options, as one parser: what needs tyro."""

from __future__ import annotations

from typing import Annotated, Any, Union

import tyro

from jaxslam.cli.calibrate import CalibrateOptions
from jaxslam.cli.consistency import ConsistencyOptions
from jaxslam.cli.evaluate import EvaluateOptions
from jaxslam.cli.track import TrackOptions
from jaxslam.cli.triangulate import TriangulateOptions

_COMMANDS = {
    "consistency": (ConsistencyOptions, "Simulate many runs of filters: are they consistent?"),
    "evaluate": (EvaluateOptions, "Test the consistency of your own filter from its errors."),
    "track": (TrackOptions, "Track a camera through a video: trajectory, map, overlay."),
    "calibrate": (
        CalibrateOptions,
        "Calibrate a camera, with uncertainty, from a video of a board.",
    ),
    "triangulate": (
        TriangulateOptions,
        "How well do two views determine a depth, and is the estimate consistent?",
    ),
}
Command: Any = Union[  # noqa: UP007 (of a table)
    tuple(
        Annotated[options, tyro.conf.subcommand(name, description=told)]
        for name, (options, told) in _COMMANDS.items()
    )
]


def parse(arguments: list[str]) -> Any:
    """The options of a command line, to be `run`; it ends with status 2 where it is none."""
    return tyro.cli(
        Command,
        args=arguments,
        prog="jaxslam",
        description="Monocular EKF-SLAM with consistent uncertainty. --version prints the version.",
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.HelptextFromCommentsOff),
    )
