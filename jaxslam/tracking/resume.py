"""A file from which a tracker goes on: a header of words and numbers, and arrays by name."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam._runtime.files import read_arrays, write_atomically

FORMAT = "jaxslam tracker 2"


def write_record(
    path: str | Path, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
) -> None:
    """Write both as one .npz archive, whole or not at all. Numbers keep their last digit."""
    text = json.dumps({"format": FORMAT, **header}, allow_nan=False)
    with write_atomically(path) as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, header=np.array(text), **arrays)


def read_record(path: str | Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays. Raises ValueError, naming the file, for one of another kind."""
    arrays = read_arrays(path)
    try:
        header = json.loads(str(arrays.pop("header")))
    except (ValueError, KeyError):
        header = {}
    if not isinstance(header, dict):
        header = {}
    if header.get("format") != FORMAT:
        raise ValueError(f"{path}: is no tracker's file ({FORMAT})")
    return header, arrays


def leaves(tree: Any, name: str) -> dict[str, np.ndarray]:
    """The arrays of a pytree by `name` and their places."""
    return {f"{name}/{i}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(tree))}


def grown(like: Any, arrays: Mapping[str, np.ndarray], name: str) -> Any:
    """The pytree that `leaves` were of, built as `like`. Raises ValueError where that differs."""
    old, structure = jax.tree.flatten(like)
    prefix = f"{name}/"
    found = [arrays.get(f"{prefix}{i}") for i in range(len(old))]
    count = sum(key.startswith(prefix) for key in arrays)
    same = [
        new is not None and (new.shape, new.dtype) == (leaf.shape, leaf.dtype)
        for new, leaf in zip(found, old, strict=True)
    ]
    if count != len(old) or not all(same):
        raise ValueError("the state in the file is of another filter than the one that goes on")
    return jax.tree.unflatten(structure, [jnp.asarray(new) for new in found])
