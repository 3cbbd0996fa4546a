"""Compile C++ to a library and load it; it is kept in the cache folder as other programs are."""

from __future__ import annotations

import atexit
import hashlib
import os
import shlex
import shutil
import subprocess
import tempfile
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

from jaxslam._runtime import programs
from jaxslam._runtime.files import write_atomically
from jaxslam.native.emit import PRELUDE, CppSource

FLAGS = (
    *("-std=c++17", "-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math"),
    *("-ffp-contract=fast", "-Wno-psabi", "-fPIC"),
)


LIMIT_SECONDS = 900.0
"""Seconds that a compiler may take."""


def compiler() -> list[str] | None:
    """The command of `$CXX`, or of the system's compiler; None without one."""
    told = shlex.split(os.environ.get("CXX", ""))
    names = told[:1] or ["c++", "g++", "clang++"]
    found = next((path for name in names if (path := shutil.which(name))), None)
    return None if found is None else [found, *told[1:]]


def described() -> tuple[str, ...] | None:
    """Return what decides a program beside its source; None without a compiler."""
    command = compiler()
    if command is None:
        return None
    return *command, *FLAGS, _version(tuple(command)), *programs.processor(), PRELUDE.read_text()


def built(source: CppSource) -> Path:
    """The library of a program. Raises ValueError without a compiler, or where it fails."""
    command, told = compiler(), described()
    if command is None or told is None:
        raise ValueError("the native backend needs a C++ compiler: none is found ($CXX, c++, g++)")
    text = "\n".join([source.text, *told])
    name = f"native-{hashlib.sha256(text.encode() + source.tables).hexdigest()}.so"
    for folder in filter(None, (programs.kept_in(), _own_folder())):
        try:
            if not _trusted(folder / name):
                _build(command, source, folder / name)
            return folder / name
        except OSError as error:  # a full disk, a folder that may not be written
            why = error
    raise ValueError(f"the native backend cannot keep its program ({why})")


def trusted(name: str) -> str:
    """The library of this name. Raises ValueError where it is not there, whole and this user's."""
    path = (programs.kept_in() or _own_folder()) / name
    if not _trusted(path):
        raise ValueError(f"{path} is not there, or is not to be trusted")
    return str(path)


def _build(command: list[str], source: CppSource, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with write_atomically(path) as temporary:
        _compile(command, source, temporary)
        whole = _digest(temporary)
    with write_atomically(_told(path)) as temporary:
        temporary.write_text(whole)


def _trusted(path: Path) -> bool:
    """Whether it is there, whole and this user's."""
    try:
        own = not hasattr(os, "getuid") or path.stat().st_uid == os.getuid()
        return own and _digest(path) == _told(path).read_text()
    except (OSError, UnicodeDecodeError):
        return False


def _told(path: Path) -> Path:
    """Return the path of a library's digest."""
    return path.with_suffix(".sha256")


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _compile(command: list[str], source: CppSource, path: Path) -> None:
    """Compile the parts, as many at a time as there are processors, and link them."""
    with tempfile.TemporaryDirectory() as folder:
        file, tables = (Path(folder) / name for name in ("program.cpp", "tables"))
        file.write_text(source.text)
        tables.write_bytes(source.tables)
        objects = [str(Path(folder) / f"{part}.o") for part in range(source.parts)]

        def compiled(part: int) -> None:
            what = [f'-DTABLES="{tables}"', f"-DPART={part}", "-c", str(file), "-o", objects[part]]
            _called([*command, *FLAGS, *what])

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(compiled, range(source.parts)))
        _called([*command, *FLAGS, "-shared", *objects, "-o", str(path), "-lm"])


def _called(arguments: list[str]) -> None:
    try:
        done = subprocess.run(arguments, capture_output=True, text=True, timeout=LIMIT_SECONDS)
    except subprocess.TimeoutExpired:
        raise ValueError(f"the C++ compiler did not end within {LIMIT_SECONDS:.0f} s") from None
    if done.returncode:
        raise ValueError(f"the C++ compiler failed: {done.stderr[-2000:]}")


def vector_bytes() -> int:
    """The bytes of this processor's vectors: a program of longer ones is many times slower, and
    takes minutes to compile. Without a compiler, those of a processor with the longest."""
    command = compiler()
    return 64 if command is None else _vector_bytes(tuple(command))


@cache
def _vector_bytes(command: tuple[str, ...]) -> int:
    asked = [*command, "-march=native", "-dM", "-E", "-x", "c++", os.devnull]
    defined = subprocess.run(asked, capture_output=True, text=True).stdout
    return 64 if "__AVX512F__" in defined else 32 if "__AVX2__" in defined else 16


@cache
def _version(command: tuple[str, ...]) -> str:
    return subprocess.run([*command, "--version"], capture_output=True, text=True).stdout


@cache
def _own_folder() -> Path:
    """Make a temporary folder of this process, for when nothing is to be kept."""
    folder = tempfile.TemporaryDirectory(prefix="jaxslam-native-")
    atexit.register(folder.cleanup)
    return Path(folder.name)
