"""The error where a library of an extra is missing: which extra, and how to install it."""

from __future__ import annotations


def missing(what: str, extra: str, error: ImportError) -> ValueError:
    """The user's mistake that `what` needs an extra, one of whose libraries was not found.

    In a clone the extra is that of the folder, which needs no release of the package.
    """
    return ValueError(
        f"{what} the {extra} extra ({error.name} is missing): pip install 'jaxslam[{extra}]', "
        f"or in a clone pip install '.[{extra}]'"
    )
