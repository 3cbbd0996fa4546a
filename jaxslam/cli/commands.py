"""The commands and their options, as one parser: what needs tyro."""

from __future__ import annotations

from typing import Annotated

import tyro

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


def parse(arguments: list[str]) -> Command:
    """The options of a command line, which ends with status 2 where it is none."""
    return tyro.cli(
        Command,
        args=arguments,
        prog="jaxslam",
        description="Monocular EKF-SLAM whose uncertainty can be believed. --version says which.",
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.HelptextFromCommentsOff),
    )
