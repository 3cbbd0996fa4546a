"""The numbers that modules hold: float64 whatever JAX's precision is, until they are used.

A module's leaves are NumPy's float64 or arrays of JAX's, so that a filter made before
`jax_enable_x64` is set loses no digit. `cast` puts all of them in one precision.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeVar, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Float, PyTree

T = TypeVar("T")

if TYPE_CHECKING:
    # The type checker does not know that a converter makes arrays of what a field is given.
    AnyArray = Any
else:
    AnyArray = jax.Array | np.ndarray

Number = Float[AnyArray, ""] | float
"""One number as a caller has it: Python's, or an array's."""


def numbers(values: PyTree) -> AnyArray:
    """An array of floating-point numbers; JAX's arrays are left as they are."""
    if isinstance(values, jax.Array):
        return values
    if isinstance(values, tuple | list) and any(isinstance(x, jax.Array) for x in values):
        return jnp.stack(values)
    if np.iscomplexobj(values):
        raise ValueError("real numbers are accepted, not complex ones")
    return np.asarray(values, np.float64)


def optional_numbers(values: PyTree) -> AnyArray | None:
    """`numbers`, or None."""
    return None if values is None else numbers(values)


def number_field(**options: Any) -> Any:
    """A field of a module that holds numbers."""
    return eqx.field(converter=numbers, **options)


def is_number(leaf: PyTree) -> bool:
    """Whether a leaf is data, to be traced, batched and differentiated."""
    return isinstance(leaf, jax.Array | np.ndarray | jax.ShapeDtypeStruct)


def is_known(leaf: PyTree) -> bool:
    """Whether it is one number or an array of them, which is not being traced."""
    return isinstance(leaf, int | float | np.ndarray | jax.Array) and not isinstance(leaf, Tracer)


def cast(tree: T, dtype: DTypeLike) -> T:
    """A filter, or any module, with all its floating-point numbers in one precision.

    Raises ValueError for a name of none.
    """
    if isinstance(dtype, str) and dtype not in ("float64", "float32", "float16", "bfloat16"):
        raise ValueError(f"unknown dtype {dtype!r}; known: float64, float32")

    def one(leaf):
        if isinstance(leaf, jax.Array) and leaf.dtype == dtype:
            return leaf
        if isinstance(leaf, jax.Array | np.ndarray) and jnp.issubdtype(leaf.dtype, jnp.floating):
            return jnp.asarray(leaf, dtype)
        return leaf

    return jax.tree.map(one, tree)


def precision(tree: PyTree) -> np.dtype:
    """The dtype of a module's numbers as JAX computes with them now.

    Warns where they are float64 and JAX, `jax_enable_x64` being off, makes them float32: a filter
    in single precision is one that was `cast` to it.
    """
    leaves = [x for x in jax.tree.leaves(tree) if isinstance(x, jax.Array | np.ndarray)]
    wanted = np.result_type(*(x.dtype for x in leaves if jnp.issubdtype(x.dtype, jnp.floating)))
    dtype = jax.dtypes.canonicalize_dtype(wanted)
    if dtype != wanted:
        warnings.warn(
            "the state is float32, because JAX has no float64 until jax.config.update("
            '"jax_enable_x64", True); jaxslam.cast(slam, "float32") chooses it without a warning',
            stacklevel=4,
        )
    return dtype


def check_shape(what: str, array: ArrayLike, *shapes: tuple[int, ...]) -> None:
    """Raise ValueError, naming the number, unless it has one of these shapes."""
    if np.shape(array) not in shapes:
        wanted = " or ".join(str(shape) for shape in shapes)
        raise ValueError(f"{what} has shape {np.shape(array)}; it needs {wanted}")


def check_numbers(what: str, value: Any, least: str = "") -> None:
    """Raise ValueError, naming what it is, unless its numbers are finite and of this sign.

    Words, pieces, and numbers that are being traced are let through.
    """
    for one in jax.tree.leaves(value) if isinstance(value, tuple) else (value,):
        for number in np.ravel(one).tolist() if is_known(one) else ():
            if not math.isfinite(number):
                raise ValueError(f"{what} holds {number}; it must be finite")
            if least and (number < 0 or (least == "positive" and not number)):
                wanted = "be positive" if least == "positive" else "not be negative"
                raise ValueError(f"{what} must {wanted}, not {number}")


def check_leaves(module: eqx.Module) -> None:
    """Raise ValueError, naming it, for a number of a module that is not finite, or a σ below 0."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(module):
        name = jax.tree_util.keystr(path).lstrip(".")
        is_sigma = name.endswith("sigma") and np.ndim(leaf) < 2  # else it may be a root R of R Rᵀ
        check_numbers(name, leaf, "not negative" if is_sigma else "")


def check_kinds(module: eqx.Module, kinds: Mapping[str, Any]) -> None:
    """Raise ValueError, naming it, for a piece of a module that is not one of its kind."""
    for name, kind in kinds.items():
        if not isinstance(piece := getattr(module, name), kind):
            wanted = (get_args(kind) or (kind,))[0].__name__
            raise ValueError(f"{name} is an instance of {wanted}, not {piece!r}")
