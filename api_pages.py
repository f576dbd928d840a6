"""Writes the pages of slamlib's functions into a folder: python api_pages.py FOLDER.

The pages load nothing. Every module has one, and every function is on that of its module.
"""

import inspect
import os
import re
import sys
from dataclasses import is_dataclass
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules, walk_packages

import pdoc

import slamlib

# A section of a docstring: its heading and its lines.
SECTION = re.compile(r"^(Parameters|Returns|Raises)\n-+\n((?:.+\n?|\n(?! *\w+\n-))*)", re.MULTILINE)
ENTRY = re.compile(r"^(\S.*?) : ", re.MULTILINE)        # begins an entry of a section
# A field of a record, and the comment with its shape and unit.
FIELD = re.compile(r"^    (\w+): .*?  # ?(.*)", re.MULTILINE)


def as_markdown(docstring: str) -> str:
    """The docstring with its sections as lists: an entry is `name : what it is`."""
    def as_list(section):
        entries = ENTRY.sub(r"* `\1`: ", section[2])
        return f"**{section[1]}**\n\n{entries}"

    return SECTION.sub(as_list, docstring)


def with_fields(record: type):
    """Add the comments of a class on its fields, which pages do not show, to its docstring."""
    fields = FIELD.findall(inspect.getsource(record))
    listed = "\n".join(f"* `{name}`: {comment}" for name, comment in fields)
    docstring = inspect.getdoc(record) or ""
    record.__doc__ = f"{docstring}\n\n{listed}"


def main(folder: str):
    """Write the pages of all modules to `folder`, and print where they are."""
    os.environ.setdefault("PDOC_ALLOW_EXEC", "1")       # Python's module platform asks the system
    for name in slamlib.__all__:
        getattr(slamlib, name)                          # imported when it is asked for
    modules = [slamlib]
    modules += [import_module(each.name) for each in walk_packages(slamlib.__path__, "slamlib.")]
    for module in modules:
        if hasattr(module, "__all__") and hasattr(module, "__path__"):    # else pdoc omits modules
            module.__all__ += [each.name for each in iter_modules(module.__path__)]
        for name, record in inspect.getmembers(module, inspect.isclass):
            if record.__module__ == module.__name__ and is_dataclass(record) and name[0] != "_":
                with_fields(record)
    pdoc.docstrings.numpy = as_markdown      # pdoc's takes the first line of an entry for a type
    pdoc.render.configure(docformat="numpy")
    pdoc.pdoc(slamlib.__name__, output_directory=Path(folder))
    print(f"Pages of all functions: {Path(folder).resolve() / 'index.html'}")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except OSError as error:
        sys.exit(f"cannot be written: {error.filename}: {error.strerror}")
