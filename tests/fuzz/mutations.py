"""What can happen to a file or an array on its way: the bad input of `fuzz.py`."""

import io
import shutil
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

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

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.write_text, (self.path, MARK)


def one_of(draw, things):
    return things[int(draw.integers(len(things)))]


def mutated_bytes(draw, data, others):
    """The file's bytes after one accident."""
    i, j = sorted(int(x) for x in draw.integers(0, len(data) + 1, 2))
    noise = draw.integers(0, 256, int(draw.integers(1, 40)), np.uint8).tobytes()
    flipped = np.frombuffer(data, np.uint8).copy()
    if flipped.size:
        places = draw.integers(0, flipped.size, int(draw.integers(1, 4)))
        flipped[places] ^= draw.integers(1, 256, places.size, np.uint8)
    made = [
        *(b"", data[:i], data[i:], data[:i] + data[j:], data + data, noise, data + noise),
        *(data[:i] + noise + data[i:], data[:i] + noise + data[i + len(noise) :]),
        *(b"\xef\xbb\xbf" + data, data.replace(b"\n", b"\r\n"), flipped.tobytes()),
        data.decode("utf-8", "ignore").encode("utf-16"),
        one_of(draw, others) if others else b"\x00" * 100,
    ]
    return one_of(draw, made)


def mutated_text(draw, text):
    """A text after one accident to a word or a line of it."""
    lines = text.splitlines()
    if not lines:
        return one_of(draw, WORDS)
    i, j = (int(x) for x in draw.integers(0, len(lines), 2))
    words = lines[i].split(" ")
    changes = [
        *4 * [lambda: lines.__setitem__(i, _word_replaced(draw, lines[i]))],
        lambda: lines.pop(i),
        lambda: lines.insert(i, lines[j]),
        lambda: lines.__setitem__(slice(None), [lines[j], *lines[:j], *lines[j + 1 :]]),
        lambda: lines.__setitem__(i, " ".join(one_of(draw, (words[:-1], [*words, words[-1]])))),
    ]
    one_of(draw, changes)()
    return "\n".join(lines) + "\n"


def _word_replaced(draw, line):
    """One word of a line, between spaces, commas, brackets, colons and quotes, is another."""
    ends = [i for i, letter in enumerate(line) if letter in ' ,:=[]{}"\t']
    starts = [0, *(i + 1 for i in ends)]
    pairs = [(a, b) for a, b in zip(starts, [*ends, len(line)], strict=True) if b > a]
    a, b = one_of(draw, pairs or [(0, len(line))])
    return line[:a] + one_of(draw, WORDS) + line[b:]


def mutated_array(draw, x):
    """An array of another shape, type or value."""
    value, axis = one_of(draw, NUMBERS), int(draw.integers(max(x.ndim, 1)))
    of_any_shape = [
        *(lambda: x[..., None], lambda: x[None], lambda: x.T, lambda: x.ravel()),
        *(lambda: np.zeros(()), lambda: np.zeros((0, 0)), lambda: np.zeros_like(x)),
        *(lambda: np.asarray(x, float) * value, lambda: -x if x.dtype.kind in "fi" else x),
        *3 * [lambda: _one_changed(draw, x, value)],
        lambda: _cast(x, one_of(draw, DTYPES)),
    ]
    of_axes = [
        *(lambda: x[:0], lambda: x[..., :-1], lambda: np.moveaxis(x, 0, -1)),
        *(lambda: np.flip(x, axis), lambda: np.repeat(x, 2, axis)),
        lambda: np.asfortranarray(x)[..., ::-1],
    ]
    with np.errstate(all="ignore"):
        return one_of(draw, of_any_shape + (of_axes if x.ndim else []))()


def _one_changed(draw, x, value):
    changed = np.array(x, float if x.dtype.kind in "fiub" else x.dtype)
    if changed.size and changed.dtype.kind == "f":
        changed.flat[int(draw.integers(changed.size))] = value
    return changed


def _cast(x, dtype):
    try:
        return x.astype(dtype)
    except (TypeError, ValueError):
        return np.full(x.shape, "x")


def mutated_npz(draw, data, trap):
    """An archive of arrays after an accident to one of them."""
    with np.load(io.BytesIO(data)) as file:
        arrays: dict[str, Any] = {name: np.asarray(file[name]) for name in file.files}
    name, kind, out = one_of(draw, list(arrays)), int(draw.integers(8)), io.BytesIO()
    chosen = arrays.pop(name)
    if kind == 1:
        arrays[f"{name}s"] = chosen
    elif kind == 2:
        arrays[name] = np.array([Trap(trap)], object)
    elif kind > 3:
        arrays[name] = mutated_array(draw, chosen)
    np.savez(out, **arrays)
    if kind == 3:
        with zipfile.ZipFile(out, "a") as archive:
            archive.writestr(f"{name}.npy", b"this is no array")
    return out.getvalue()


def mutate_folder(draw, folder, trap):
    """One accident, or two, to files of a folder."""
    for _ in range(1 + (draw.random() < 0.25)):
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        if not files:
            return
        path, chance = one_of(draw, files), draw.random()
        if chance < 0.08:
            path.unlink()
            if chance < 0.03:
                path.mkdir()
        elif chance < 0.1:
            shutil.copy(path, path.with_name(f"copy of {path.name}"))
        else:
            path.write_bytes(_mutated_file(draw, path, files, trap))


def _mutated_file(draw, path, files, trap):
    data = path.read_bytes()
    try:
        if path.suffix == ".npz" and draw.random() < 0.7:
            return mutated_npz(draw, data, trap)
    except (ValueError, OSError, zipfile.BadZipFile, EOFError):
        pass  # broken already
    if path.suffix in (".txt", ".csv", ".json", ".toml", ".yaml") and draw.random() < 0.75:
        return mutated_text(draw, data.decode("utf-8", "replace")).encode("utf-8", "replace")
    return mutated_bytes(draw, data, [other.read_bytes() for other in files if other != path])
