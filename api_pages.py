"""Writes the pages of slamlib's functions into a folder: python api_pages.py FOLDER.

The pages load nothing. Every module has one, and every function is on that of its module.
"""

import os
import re
import sys
from importlib import import_module
from pathlib import Path

import pdoc

import slamlib

# A section of a docstring: its heading and its lines.
SECTION = re.compile(r"^(Parameters|Returns|Raises)\n-+\n((?:.+\n?|\n(?! *\w+\n-))*)", re.MULTILINE)
# Packages whose `__all__` hides their modules.
PACKAGES = ("slamlib.slam", "slamlib.localization", "slamlib.studies", "slamlib.notebook",
            "slamlib.report")


def as_markdown(docstring):
    """The docstring with its sections as lists: an entry is `name : what it is`."""
    return SECTION.sub(lambda section: f"**{section[1]}**\n\n" + re.sub(
        r"^(\S.*?) : ", r"* `\1`: ", section[2], flags=re.MULTILINE), docstring)


def main(folder):
    """Write the pages of all modules to `folder`."""
    os.environ.setdefault("PDOC_ALLOW_EXEC", "1")       # Python's module platform asks the system
    for package in map(import_module, PACKAGES):
        del package.__all__                  # else pdoc would leave out the package's modules
    pdoc.docstrings.numpy = as_markdown      # pdoc's takes the first line of an entry for a type
    pdoc.render.configure(docformat="numpy", search=False)
    pdoc.pdoc(slamlib.__name__, output_directory=Path(folder))


if __name__ == "__main__":
    main(*sys.argv[1:])
