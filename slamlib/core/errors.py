"""Errors that are told in one sentence."""

from collections.abc import Callable
from typing import Any

from numpy.linalg import LinAlgError


class DatasetError(ValueError):
    """A dataset does not follow the format; one sentence names file, line and expectation."""


UNSOLVABLE = (DatasetError, LinAlgError)     # what is raised where there is no solution


def if_solvable(solve: Callable, *arguments: Any) -> Any:
    """What a function makes of its arguments, or None if there is no solution."""
    try:
        return solve(*arguments)
    except UNSOLVABLE:
        return None


def require(ok: bool, source: str, expected: str, found: object = None) -> None:
    """Raise DatasetError unless `ok`; the `source` is a file with its line, or an argument."""
    if not ok:
        told = "" if found is None else f", found {quoted(found)}"
        raise DatasetError(f"{source}: expected {expected}{told}")


def quoted(value: object) -> str:
    """The first 120 characters (str) of a value, in quotes."""
    text = str(value)
    if len(text) > 120:
        text = text[:120] + "..."
    return repr(text)
