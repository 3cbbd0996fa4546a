"""The command line: a thin layer over the library, one file a command."""

from __future__ import annotations

import os
import signal
import sys
import textwrap
import threading
from typing import NoReturn

from jaxslam._runtime.extras import missing
from jaxslam._version import __version__

_BROKEN_PIPE = 141
"""The exit status of a command that SIGPIPE ends, as a shell has it."""


def main(arguments: list[str] | None = None) -> None:
    """Run a command. A mistake of the user's ends with exit status 2 and one line."""
    try:
        _main(sys.argv[1:] if arguments is None else arguments)
    except SystemExit as end:
        if arguments is None and end.code:
            _leave(end.code)
        raise


def _main(given: list[str]) -> None:
    if given == ["--version"]:
        print(f"jaxslam {__version__}")
        return
    try:
        _run(given)
        sys.stdout.flush()
    except ValueError as error:
        _fail(2, str(error))
    except BrokenPipeError:  # whoever read standard output has enough, as `head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # it is flushed at the end
        sys.exit(_BROKEN_PIPE)
    except OSError as error:  # a path that is too long, a folder that may not be written
        _fail(2, f"{textwrap.shorten(str(error.filename), 80)}: {error.strerror or error}")
    except KeyboardInterrupt as interrupt:
        told = f": {interrupt}" if str(interrupt) else ""
        _fail(130, f"interrupted{told}")


def _run(given: list[str]) -> None:
    try:
        import tqdm  # noqa: F401

        from jaxslam.cli.cache import keep_programs
        from jaxslam.cli.commands import parse
    except ImportError as error:
        _fail(2, str(missing("the command line needs", "cli", error)))
    options = parse(given)
    signal.signal(signal.SIGTERM, _interrupt)
    keep_programs()
    options.run()


def _interrupt(*_) -> None:
    raise KeyboardInterrupt


def _fail(status: int, message: str) -> NoReturn:
    print(f"jaxslam: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(status)


def _leave(status: int | str) -> None:
    """End the process at once where Python would wait for a program that is compiled aside, for a
    minute."""
    others = set(threading.enumerate()) - {threading.main_thread()}
    if isinstance(status, int) and not all(thread.daemon for thread in others):
        sys.stdout.flush()
        os._exit(status)
