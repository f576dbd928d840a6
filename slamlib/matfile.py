"""Reads tables from .mat files of MATLAB's versions 5 to 7."""

from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from scipy.io import loadmat, whosmat

from slamlib.textfile import error, read_regular


@dataclass(frozen=True)
class Variable:
    """A table in a .mat file."""

    path: Path
    name: str

    def __str__(self):
        return f"{self.path}, variable {self.name}"


def mat_variables(path):
    """Numbers of elements (dict) by the names of variables and fields, as `logs.UwbReading`.

    The number of a struct is infinite. Raises DatasetError if a .mat file cannot be read, or is of
    another version than MATLAB's 5 to 7.
    """
    sizes = {}
    for name, shape, kind in _of_mat(whosmat, path):
        sizes[name] = np.inf if kind == "struct" else np.prod(shape)
        value = _mat_value(path, name) if kind == "struct" else None
        if isinstance(value, np.ndarray) and value.shape == (1, 1):
            sizes |= {f"{name}.{field}": np.size(value[field][0, 0])
                      for field in value.dtype.names or ()}
    return sizes


def _mat_value(path, name):
    """A variable of a .mat file, or a field of one."""
    name, *fields = name.split(".")
    value = _of_mat(loadmat, path, variable_names=[name]).get(name)
    for field in fields:
        value = value[field][0, 0]
    return value


def variable_text(source):
    """The rows of a Variable as text (str), one a line.

    Raises DatasetError if it is not a matrix of real numbers.
    """
    value = _mat_value(source.path, source.name)
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "iuf" or value.ndim != 2:
        kind = "a struct" if getattr(value, "dtype", None) is not None and value.dtype.names \
            else "a cell array" if getattr(value, "dtype", None) == object else "something else"
        raise error(source, f"expected a matrix of real numbers, found {kind}")
    return "\n".join(" ".join(map(repr, row)) for row in value.tolist())


def _of_mat(read, path, **keywords):
    """The result of a function of scipy.io on a .mat file, with DatasetErrors."""
    data = read_regular(path)
    if data.startswith((b"# Created by Octave", b"# name:")):
        raise error(path, "expected a .mat file of version 7 or older, found Octave's text: save "
                    "it with the option '-v7'")
    try:
        return read(BytesIO(data), **keywords)
    except NotImplementedError:
        raise error(path, "expected a .mat file of version 7 or older, found 7.3: save it with the "
                    "option '-v7'") from None
    except Exception:                   # scipy raises many kinds about bytes that are no .mat file
        raise error(path, "expected a .mat file that can be read") from None
