"""Programs that are compiled before they are needed, and kept from one process to the next.

JAX's cache of compiled programs spares the compiler; a program of ten thousand operations is still
traced and lowered by Python, for seconds: with that cache alone the README's first command, run
again, takes 32 s of processor time, and with this one 22 s. Here the whole is kept, if a folder is
given (`keep_in`): a file for each program, by all that it depends on. One that is damaged, or
another user's, is compiled anew. Such a file is code, and what is around it a pickle: as for JAX's
own cache, the folder is to be its user's alone.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import pickle
import platform
import secrets
import sys
import threading
import weakref
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import fields, is_dataclass
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from types import BuiltinFunctionType, FunctionType, MethodType
from typing import Any, Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.serialize_executable import deserialize_and_load, serialize
from jax.extend.core import Jaxpr
from jax.tree_util import PyTreeDef
from jaxtyping import PyTree

from jaxslam._runtime.files import write_atomically

Options = Mapping[str, Mapping[str, str | int | bool]]
"""Options of the compiler, by platform; one that it does not know is left out."""

# Without emitters of fusions it takes two thirds of the time, to programs that are as fast.
BATCHED: Options = {"cpu": {"xla_cpu_use_fusion_emitters": False}}
# Slow programs, in half of that time again.
_LEAST = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
QUICK: Options = {"cpu": {**BATCHED["cpu"], **_LEAST}}
# One run's matrices are small: kernels whose threads wait for one another are slow there, and three
# quarters of the time make programs that are as fast (a batch's would take a fifth longer).
_SMALL = {"xla_backend_optimization_level": 1, "xla_cpu_parallel_codegen_split_count": 1}
ALONE: Options = {"cpu": {**BATCHED["cpu"], **_SMALL, "xla_cpu_experimental_ynn_fusion_type": ""}}

MOST = 32
"""Structures of whose programs one keeps those that were used last."""
PACKAGES = ("jax", "jaxlib", "equinox", "jaxlie", "numpy")
"""Whose versions are known: a program of anything else but these, Python's and this package's
functions is not kept, as they may change without notice."""

T = TypeVar("T")
_PLAIN = frozenset((bool, int, str, bytes, type(None), type, FunctionType))
_kept_in: Path | None = None


def keep_in(folder: Path | None) -> None:
    """Keep every program that is made from now on in this folder, and load it from there."""
    global _kept_in
    _kept_in = folder


def kept_in() -> Path | None:
    """The folder that was given."""
    return _kept_in


_all: weakref.WeakSet[Made[Any]] = weakref.WeakSet()


def forget() -> None:
    """Free all programs that were made, as `jax.clear_caches` does JAX's: each holds some of the
    memory maps of which a process may have only so many."""
    for made in _all:
        made.forget()


class Made(Generic[T]):
    """Programs by their keys, each made by the first thread that asks; the last `MOST` are kept.

    One that could not be made is tried again.
    """

    def __init__(self) -> None:
        self._futures: dict[object, Future[T]] = {}
        self._lock = threading.Lock()
        _all.add(self)

    def of(self, key: object, make: Callable[[], T]) -> T:
        """Return the program of this key, which is the same only `exactly`, or make it."""
        key = exactly(key)
        with self._lock:
            future = self._futures.pop(key, None)
            if mine := future is None:
                future = Future()
            self._futures[key] = future  # the last
            while len(self._futures) > MOST:
                del self._futures[next(iter(self._futures))]
        if mine:
            try:
                future.set_result(make())
            except BaseException as error:
                future.set_exception(error)
                with self._lock:
                    self._futures.pop(key, None)
        return future.result()

    def __contains__(self, key: object) -> bool:
        future = self._futures.get(exactly(key))
        return future is not None and future.done() and future.exception() is None

    def __len__(self) -> int:
        return len(self._futures)

    def forget(self) -> None:
        """Free what was made."""
        with self._lock:
            self._futures.clear()


class Program:
    """A pure function of pytrees, compiled once for each structure of its arguments.

    Arrays among their leaves (or `jax.ShapeDtypeStruct`, for `compile`) are data; everything else
    is part of the program, is to be hashable, and is the same only by type and bits (`exactly`).
    What is traced may be `seen`, with the arguments, before it is compiled.
    """

    def __init__(
        self,
        function: Callable[..., PyTree],
        options: Options = ALONE,
        seen: Callable[[Jaxpr, tuple[PyTree, ...]], None] = lambda jaxpr, args: None,
    ) -> None:
        self.function, self.options, self.seen = function, options, seen
        self._made: Made[_Compiled] = Made()

    def __call__(self, *args: PyTree) -> PyTree:
        call = _Call.of(args)
        return self._compiled(call)(call.arrays)

    def compile(self, *args: PyTree) -> PyTree:
        """Compile for such arguments, or wait for who does; what it returns, as shapes."""
        return self._compiled(_Call.of(args)).shapes

    def _compiled(self, call: _Call) -> _Compiled:
        return self._made.of(call.key, partial(self._make, call))

    def _make(self, call: _Call) -> _Compiled:
        name = getattr(self.function, "__name__", type(self.function).__name__)
        place = place_of(name, (self.function, call.key, self.options))
        if place is None:
            return self._compile(call, name)
        made = read(*place, lambda shapes, *own: _Compiled(deserialize_and_load(*own), shapes))
        if made is None:
            # What JAX's own cache gave cannot be written again, but no new name is there.
            made = self._compile(call, f"{name}_{secrets.token_hex(4)}")
            keep(place[0], lambda: (made.shapes, *serialize(made.compiled)))
        return made

    def _compile(self, call: _Call, name: str) -> _Compiled:
        structures = []

        def flat(arrays):
            leaves, structure = jax.tree.flatten(self.function(*call.arguments(arrays)))
            structures.append(structure)
            return leaves

        flat.__name__ = name
        shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in call.arrays]
        # A GPU would round the factors of products of float32 to 11 bits; a CPU is slower if asked.
        with jax.default_matmul_precision(None if jax.default_backend() == "cpu" else "highest"):
            traced = jax.jit(flat).trace(shapes)
        self.seen(traced.jaxpr.jaxpr, call.arguments(shapes))
        lowered = traced.lower()
        after = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in lowered.out_info]
        compiled = _with_options(lowered, self.options)
        return _Compiled(compiled, jax.tree.unflatten(structures[-1], after))


_name = cache(lambda dtype: dtype.name)  # which NumPy makes anew each time


class _Call(NamedTuple):
    """The arguments with which a program is called."""

    arrays: list[jax.Array | jax.ShapeDtypeStruct]
    key: tuple[PyTreeDef, tuple[bool, ...], tuple[object, ...], bool]
    """Structure, and of every leaf its shape and type or, where it is no array, itself."""

    @classmethod
    def of(cls, args: tuple[PyTree, ...]) -> _Call:
        leaves, structure = jax.tree.flatten(args)
        are_arrays = tuple(hasattr(x, "shape") and hasattr(x, "dtype") for x in leaves)
        both = list(zip(leaves, are_arrays, strict=True))
        kinds = tuple((x.shape, _name(x.dtype)) if is_array else x for x, is_array in both)
        return cls([x for x, is_array in both if is_array], (structure, are_arrays, kinds, wide()))

    def arguments(self, arrays: list[PyTree]) -> tuple[PyTree, ...]:
        """Return the arguments, with these arrays in place of the call's own."""
        structure, are_arrays, kinds, _ = self.key
        rest = iter(arrays)
        leaves = [next(rest) if array else x for array, x in zip(are_arrays, kinds, strict=True)]
        return jax.tree.unflatten(structure, leaves)


def exactly(value: Any) -> object:
    """A key that equals another's where both values are of one type and have the same bits.

    `==` takes 2 for 2.0, True for 1 and −0.0 for 0.0, which programs do not, and NaN for nothing.
    What is within tuples, modules, other objects that compare by value and structures of pytrees
    is compared so too.
    """
    kind = type(value)
    if kind in _PLAIN:
        return kind, value
    if kind is tuple:
        return kind, tuple(map(exactly, value))
    if kind is PyTreeDef:
        return kind, exactly(value.node_data()), tuple(map(exactly, value.children()))
    if isinstance(value, (float, complex)):
        return kind, np.asarray(value, complex).tobytes()
    if isinstance(value, (np.generic, np.ndarray)):
        return kind, value.dtype, value.shape, value.tobytes()
    if isinstance(value, dict):
        return kind, tuple((exactly(k), exactly(x)) for k, x in value.items())
    if isinstance(value, frozenset):
        return kind, frozenset(map(exactly, value))
    if isinstance(value, (tuple, list)):
        return kind, tuple(map(exactly, value))
    if isinstance(value, partial):
        return kind, exactly((value.func, value.args, value.keywords))
    if isinstance(value, MethodType):
        return kind, value.__func__, exactly(value.__self__)
    if kind.__eq__ is object.__eq__ or isinstance(value, (type, FunctionType)):
        return value
    if is_dataclass(value):
        return kind, tuple(exactly(getattr(value, f.name, None)) for f in fields(value))
    return kind, value, exactly(getattr(value, "__dict__", ()))


def wide() -> bool:
    """Whether numbers are of 64 bits where this is asked."""
    return bool(jnp.result_type(float) == jnp.float64)


class _Compiled(NamedTuple):
    """A program of lists of arrays, and the structure of what it returns."""

    compiled: jax.stages.Compiled
    shapes: PyTree

    def __call__(self, arrays: list[PyTree]) -> PyTree:
        return jax.tree.unflatten(jax.tree.structure(self.shapes), self.compiled(arrays))


def _with_options(lowered: jax.stages.Lowered, options: Options) -> jax.stages.Compiled:
    # Who asks JAX for few optimisations, as tests do, is to have few here too.
    few = jax.config.values["jax_disable_most_optimizations"]
    own = dict((QUICK if few else options).get(jax.default_backend(), {}))
    for _ in range(len(own)):
        try:
            return lowered.compile(compiler_options=own)
        except RuntimeError as error:  # which names one that it does not know
            own = {name: x for name, x in own.items() if f"'{name}'" not in str(error)}
    return lowered.compile()


def in_background(*steps: Callable[[], object], threads: int = 1) -> list[threading.Thread]:
    """Take the steps aside, in their order, each by the first thread that is free; those not
    started when the process ends are left out. What goes wrong will do so again where it is
    needed."""
    left, of_64_bits = iter(steps), wide()

    def take() -> None:
        with jax.enable_x64(of_64_bits):
            for step in left:
                if threading.main_thread().is_alive():
                    with contextlib.suppress(Exception):
                        step()

    taking = [threading.Thread(target=take) for _ in range(threads)]
    for thread in taking:
        thread.start()
    return taking


class _Pickled(NamedTuple):
    """A pickle in which functions are only named; and these."""

    data: bytes
    functions: dict[str, FunctionType]

    @classmethod
    def of(cls, value: object) -> _Pickled:
        file = io.BytesIO()
        pickler = _Pickler(file)
        pickler.dump(value)
        return cls(file.getvalue(), pickler.functions)


class _Pickler(pickle.Pickler):
    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file, protocol=5)
        # Equal things are to have equal pickles, be they one or two.
        self.fast = True
        self.functions: dict[str, FunctionType] = {}

    def persistent_id(self, obj: object) -> str | None:
        if isinstance(obj, type | FunctionType | BuiltinFunctionType) and not _known(obj):
            raise pickle.PicklingError(f"{obj.__qualname__} may change without notice")
        if not isinstance(obj, FunctionType):
            return None
        if obj.__closure__:
            raise pickle.PicklingError(f"{obj.__qualname__} has values that nothing tells")
        name = f"{obj.__module__}.{obj.__qualname__}:{obj.__code__.co_firstlineno}"
        self.functions[name] = obj
        return name


def _known(obj: type | FunctionType | BuiltinFunctionType) -> bool:
    package = (obj.__module__ or "builtins").partition(".")[0]
    return package in ("jaxslam", *PACKAGES) or package in sys.stdlib_module_names


class _Unpickler(pickle.Unpickler):
    def __init__(self, data: bytes, functions: dict[str, FunctionType]) -> None:
        super().__init__(io.BytesIO(data))
        self._functions = functions

    def persistent_load(self, pid: str) -> FunctionType:
        return self._functions[pid]


def place_of(name: str, key: object) -> tuple[Path, dict[str, FunctionType]] | None:
    """Where to `keep` what depends on a key, this package and this machine, and to `read` it.

    None where nothing is kept, or the key may change without notice.
    """
    if _kept_in is None:
        return None
    try:
        data, functions = _Pickled.of((key, _surroundings()))
    except (pickle.PicklingError, AttributeError, TypeError):
        return None
    return _kept_in / f"{name}-{hashlib.sha256(data).hexdigest()}.program", functions


def read(path: Path, functions: dict[str, FunctionType], load: Callable[..., T]) -> T | None:
    """What was kept, by its parts; None where there is none, or where it is not to be trusted."""
    try:
        if hasattr(os, "getuid") and path.stat().st_uid != os.getuid():
            return None
        digest, data = path.read_bytes().split(b"\n", 1)
        if digest.decode() != hashlib.sha256(data).hexdigest():
            return None
        return load(*_Unpickler(data, functions).load())
    except Exception:  # of another version, of any kind
        return None


def keep(path: Path, parts: Callable[[], tuple[object, ...]]) -> None:
    """Keep these parts, if it can be."""
    try:
        data = _Pickled.of(parts()).data
        path.parent.mkdir(parents=True, exist_ok=True)
        with write_atomically(path) as temporary:
            temporary.write_bytes(hashlib.sha256(data).hexdigest().encode() + b"\n" + data)
    except Exception:  # a full disk, a program that cannot be written: compiled again next time
        return


def _surroundings() -> tuple[object, ...]:
    """All that a program depends on beside its function's arguments."""
    device = jax.devices()[0]
    config = jax.config.values
    settings = sorted((name, str(x)) for name, x in config.items() if "cache" not in name)
    where = device.client.platform_version, device.device_kind, len(jax.devices())
    return _sources(), *where, settings, os.environ.get("XLA_FLAGS")


def source_files() -> list[Path]:
    """All Python files of this package, in order."""
    return sorted(Path(__file__).parents[1].rglob("*.py"))


@cache
def _sources() -> tuple[str, ...]:
    """Return what identifies this package, those that it computes with and this processor."""
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in source_files()))
    versions = (version(name) for name in PACKAGES)
    return digest.hexdigest(), platform.python_version(), *versions, *processor()


def processor() -> tuple[str, ...]:
    """Return the kind and name of this machine's processor, and its features."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    features = [line for line in lines if line.lower().startswith(("flags", "features"))]
    return platform.machine(), platform.processor(), *features[:1]
