"""The commands and their options, as one parser: what needs tyro."""

from __future__ import annotations

from typing import Annotated, Any, Union

import tyro

from jaxslam.cli.calibrate import CalibrateOptions
from jaxslam.cli.consistency import ConsistencyOptions
from jaxslam.cli.evaluate import EvaluateOptions
from jaxslam.cli.track import TrackOptions
from jaxslam.cli.triangulate import TriangulateOptions

_COMMANDS = (
    ConsistencyOptions, EvaluateOptions, TrackOptions, CalibrateOptions, TriangulateOptions,
)  # fmt: skip
"""A command is called by its class without `Options`; every field is an option of it, and its
docstring says what it does."""


Command: Any = Union[  # noqa: UP007 (of a table)
    tuple(
        Annotated[x, tyro.conf.subcommand(x.__name__[:-7].lower(), description=x.__doc__)]
        for x in _COMMANDS
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
