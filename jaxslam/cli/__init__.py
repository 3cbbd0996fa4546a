"""The command line: a thin layer over the library, one file a command."""

from __future__ import annotations

import gc
import os
import signal
import sys
import textwrap
import threading
from collections.abc import Generator
from contextlib import contextmanager
from typing import NoReturn

from jaxslam._runtime.extras import missing
from jaxslam._version import __version__

_INTERRUPTED, _BROKEN_PIPE = 130, 141
"""The exit status of a command that SIGINT, or SIGPIPE, ends, as a shell has it."""


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
    except OSError as end:  # a path that is too long, a folder that may not be written, a full disk
        _fail(2, f"{textwrap.shorten(str(end.filename or 'writing'), 80)}: {end.strerror or end}")
    except KeyboardInterrupt as interrupt:
        told = f": {interrupt}" if str(interrupt) else ""
        _fail(_INTERRUPTED, f"interrupted{told}")


def _run(given: list[str]) -> None:
    gc.set_threshold(50_000, 20, 100)  # by default a tenth of the time: tracing makes many objects
    with _interruptions():
        try:
            import tqdm  # noqa: F401

            from jaxslam.cli.cache import keep_programs
            from jaxslam.cli.commands import parse
        except ImportError as error:
            if _interrupted.is_set():
                raise
            _fail(2, str(missing("the command line needs", "cli", error)))
        options = parse(given)
        keep_programs()
        if _interrupted.is_set():  # a library that was imported has printed it, and gone on
            raise KeyboardInterrupt
        options.run()


_interrupted = threading.Event()


@contextmanager
def _interruptions() -> Generator[None]:
    """Ctrl-C and SIGTERM end the block by KeyboardInterrupt, wherever they come.

    Python has nobody to raise it to where an object ends: it then comes once more. A library that
    is being imported, or that calls back, may make an error of its own of it.
    """
    _interrupted.clear()
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:  # as behind nohup, or in a script's `&`
            signal.signal(number, _interrupt)
    before = sys.unraisablehook

    def swallowed(told) -> None:
        if not isinstance(told.exc_value, KeyboardInterrupt):
            return before(told)
        # Seconds after which an interruption comes once more, then to somebody.
        return threading.Timer(0.01, os.kill, (os.getpid(), signal.SIGINT)).start()

    sys.unraisablehook = swallowed
    try:
        yield
    except Exception:
        if _interrupted.is_set():
            raise KeyboardInterrupt from None
        raise
    finally:
        sys.unraisablehook = before


def _interrupt(*_) -> None:
    _interrupted.set()
    raise KeyboardInterrupt


def _fail(status: int, message: str) -> NoReturn:
    print(f"jaxslam: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(status)


def _leave(status: int | str) -> None:
    """End the process at once where Python would wait for a program that is compiled aside, for a
    minute, or dies of an interruption that was heard."""
    others = set(threading.enumerate()) - {threading.main_thread()}
    waits = not all(thread.daemon for thread in others)
    if isinstance(status, int) and (waits or status == _INTERRUPTED):
        sys.stdout.flush()
        os._exit(status)
