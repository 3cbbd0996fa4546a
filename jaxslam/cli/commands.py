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
"""Every field of one is an option, and its docstring what the command does."""


def _command(options: type) -> Any:
    name = options.__name__.removesuffix("Options").lower()
    return Annotated[options, tyro.conf.subcommand(name, description=options.__doc__)]


Command: Any = Union[tuple(map(_command, _COMMANDS))]  # noqa: UP007 (of a table)


def parse(arguments: list[str]) -> Any:
    """The options of a command line, to be `run`; it ends with status 2 where it is none."""
    return tyro.cli(
        Command,
        args=arguments,
        prog="jaxslam",
        description="Monocular EKF-SLAM with consistent uncertainty. --version prints the version.",
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.HelptextFromCommentsOff),
    )
