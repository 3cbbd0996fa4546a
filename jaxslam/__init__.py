"""jaxslam: monocular EKF-SLAM whose uncertainty can be believed.

The models are pure functions of one pose and one landmark; the filters, the Monte Carlo study
and the tracker all run on the same ones. Every name of `__init__.pyi` is imported when it is
first asked for, so that evaluating a trajectory needs no filter, and a filter no camera. The
vision extra is needed by `jaxslam.Tracker` and `jaxslam.TrackerSettings`.
"""

import ast
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

_STUB = ast.parse(Path(__file__).with_suffix(".pyi").read_text())
_MODULE_OF = {
    alias.name: node.module
    for node in _STUB.body
    if isinstance(node, ast.ImportFrom) and node.module
    for alias in node.names
}
(__all__,) = (ast.literal_eval(x.value) for x in _STUB.body if isinstance(x, ast.Assign))


def __getattr__(name: str) -> Any:
    module = f"jaxslam.{name}"
    if name in _MODULE_OF:
        return _imported(name)
    if not name.startswith("__") and find_spec(module) is not None:
        return import_module(module)
    from jaxslam._runtime.lookup import suggestion

    raise AttributeError(f"module 'jaxslam' has no attribute {name!r}{suggestion(name, __dir__())}")


def _imported(name: str) -> Any:
    try:
        return getattr(import_module(_MODULE_OF[name]), name)
    except ModuleNotFoundError as error:
        if name != "Tracker":
            raise
        from jaxslam._runtime.extras import missing

        raise missing("a Tracker needs", "vision", error) from None


def __dir__() -> list[str]:
    return [*__all__, "Tracker", "TrackerSettings"]
