"""What can happen to a file or an array on its way: the bad input of `fuzz.py`."""

from __future__ import annotations

import io
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Draw = np.random.Generator
WORDS = (
    "nan", "inf", "-inf", "1e308", "-1e308", "1e-320", "1e400", "0", "-0.0", "-1", "1", "2", "7.5",
    "abc", '""', "true", "null", "[]", "{}", "[[1]]", "1,5", "−1", "٣", "1_000", "0x10", "9" * 400,
    "2024-01-01", "é", "\x00", "a b", "'", "../x", "#", "1e5", "1.7976931348623157e308",
)  # fmt: skip
NUMBERS = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e308, -1e308, 1e-320, 1e160, 1e30, 2.0, 0.5)
DTYPES = ("float32", "float16", "int64", "int8", "uint8", "bool", "complex128", "U8", "S3", "M8[s]")
MARK = "a pickle was run"


class Trap:
    """An object whose pickle, once loaded, leaves a mark: no reader may load it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.write_text, (self.path, MARK)


def mutated_bytes(draw: Draw, data: bytes, others: list[bytes]) -> bytes:
    """The file's bytes after one accident."""
    i, j = sorted(int(x) for x in draw.integers(0, len(data) + 1, 2))
    noise = draw.integers(0, 256, int(draw.integers(1, 40)), np.uint8).tobytes()
    kinds: list[Callable[[], bytes]] = [
        lambda: b"",
        lambda: data[:i],
        lambda: data[i:],
        lambda: data[:i] + data[j:],
        lambda: data[:i] + noise + data[i:],
        lambda: data[:i] + noise + data[i + len(noise) :],
        lambda: data + noise,
        lambda: data + data,
        lambda: noise,
        lambda: b"\xef\xbb\xbf" + data,
        lambda: data.replace(b"\n", b"\r\n"),
        lambda: data.decode("utf-8", "ignore").encode("utf-16"),
        lambda: others[int(draw.integers(len(others)))] if others else b"\x00" * 100,
        lambda: _flipped(draw, data),
    ]
    return kinds[int(draw.integers(len(kinds)))]()


def _flipped(draw: Draw, data: bytes) -> bytes:
    flipped = np.frombuffer(data, np.uint8).copy()
    if flipped.size:
        places = draw.integers(0, flipped.size, int(draw.integers(1, 4)))
        flipped[places] ^= draw.integers(1, 256, places.size, np.uint8)
    return flipped.tobytes()


def mutated_text(draw: Draw, text: str) -> str:
    """A text after one accident to a word or a line of it."""
    lines = text.splitlines()
    if not lines:
        return WORDS[int(draw.integers(len(WORDS)))]
    i, j = (int(x) for x in draw.integers(0, len(lines), 2))
    kind = int(draw.integers(8))
    if kind < 4:
        lines[i] = _word_replaced(draw, lines[i])
    elif kind == 4:
        del lines[i]
    elif kind == 5:
        lines.insert(i, lines[j])
    elif kind == 6:
        lines[i], lines[j] = lines[j], lines[i]
    else:
        words = lines[i].split(" ")
        lines[i] = " ".join(words[:-1] if draw.random() < 0.5 else [*words, words[-1]])
    return "\n".join(lines) + "\n"


def _word_replaced(draw: Draw, line: str) -> str:
    """One word of a line, between spaces, commas, brackets, colons and quotes, is another."""
    marks = ' ,:=[]{}"\t'
    ends = [i for i, letter in enumerate(line) if letter in marks]
    starts = [0, *(i + 1 for i in ends)]
    pairs = [(a, b) for a, b in zip(starts, [*ends, len(line)], strict=True) if b > a]
    word = WORDS[int(draw.integers(len(WORDS)))]
    if not pairs:
        return word
    a, b = pairs[int(draw.integers(len(pairs)))]
    return line[:a] + word + line[b:]


def mutated_array(draw: Draw, x: np.ndarray) -> np.ndarray:
    """An array of another shape, type or value."""
    value = NUMBERS[int(draw.integers(len(NUMBERS)))]
    axis = int(draw.integers(max(x.ndim, 1)))
    kinds: list[Callable[[], np.ndarray]] = [
        lambda: x[..., None],
        lambda: x[None],
        lambda: x[:0] if x.ndim else x,
        lambda: x[..., :-1] if x.ndim else x,
        lambda: np.moveaxis(x, 0, -1) if x.ndim else x,
        lambda: x.T,
        lambda: x.ravel(),
        lambda: np.zeros(()),
        lambda: np.zeros((0, 0)),
        lambda: np.asarray(x, float) * value,
        lambda: _one_changed(draw, x, value),
        lambda: _one_changed(draw, x, value),
        lambda: _one_changed(draw, x, value),
        lambda: np.zeros_like(x),
        lambda: -x if x.dtype.kind in "fi" else x,
        lambda: np.flip(x, axis) if x.ndim else x,
        lambda: _cast(x, DTYPES[int(draw.integers(len(DTYPES)))]),
        lambda: np.repeat(x, 2, axis) if x.ndim else x,
        lambda: np.asfortranarray(x)[..., ::-1] if x.ndim else x,
    ]
    with np.errstate(all="ignore"):
        return kinds[int(draw.integers(len(kinds)))]()


def _one_changed(draw: Draw, x: np.ndarray, value: float) -> np.ndarray:
    changed = np.array(x, float if x.dtype.kind in "fiub" else x.dtype)
    if changed.size and changed.dtype.kind == "f":
        changed.flat[int(draw.integers(changed.size))] = value
    return changed


def _cast(x: np.ndarray, dtype: str) -> np.ndarray:
    try:
        return x.astype(dtype)
    except (TypeError, ValueError):
        return np.full(x.shape, "x")


def mutated_npz(draw: Draw, data: bytes, trap: Path) -> bytes:
    """An archive of arrays after an accident to one of them."""
    with np.load(io.BytesIO(data)) as file:
        arrays: dict[str, Any] = {name: np.asarray(file[name]) for name in file.files}
    name = list(arrays)[int(draw.integers(len(arrays)))]
    kind = int(draw.integers(8))
    if kind == 0:
        del arrays[name]
    elif kind == 1:
        arrays[f"{name}s"] = arrays.pop(name)
    elif kind == 2:
        arrays[name] = np.array([Trap(trap)], object)
    elif kind == 3:
        return _with_raw(arrays, name, b"this is no array")
    else:
        arrays[name] = mutated_array(draw, arrays[name])
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()


def _with_raw(arrays: dict[str, Any], name: str, raw: bytes) -> bytes:
    """An archive in which one member is no array."""
    out = io.BytesIO()
    np.savez(out, **{key: value for key, value in arrays.items() if key != name})
    with zipfile.ZipFile(out, "a") as archive:
        archive.writestr(f"{name}.npy", raw)
    return out.getvalue()


def mutate_folder(draw: Draw, folder: Path, trap: Path) -> None:
    """One accident, or two, to files of a folder."""
    for _ in range(1 + (draw.random() < 0.25)):
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        if not files:
            return
        path = files[int(draw.integers(len(files)))]
        chance = draw.random()
        if chance < 0.05:
            path.unlink()
        elif chance < 0.08:
            path.unlink()
            path.mkdir()
        elif chance < 0.1:
            shutil.copy(path, path.with_name(f"copy of {path.name}"))
        else:
            path.write_bytes(_mutated_file(draw, path, files, trap))


def _mutated_file(draw: Draw, path: Path, files: list[Path], trap: Path) -> bytes:
    data = path.read_bytes()
    try:
        if path.suffix == ".npz" and draw.random() < 0.7:
            return mutated_npz(draw, data, trap)
    except (ValueError, OSError, zipfile.BadZipFile, EOFError):
        pass  # broken already
    if path.suffix in (".txt", ".csv", ".json", ".toml", ".yaml") and draw.random() < 0.75:
        return mutated_text(draw, data.decode("utf-8", "replace")).encode("utf-8", "replace")
    return mutated_bytes(draw, data, [other.read_bytes() for other in files if other != path])
