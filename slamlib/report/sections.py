"""Sections of the chapters, and which of them a report shows.

A section begins with a heading of level 2 or 3 and ends before the next one of the same or a higher
level. A Markdown cell that begins with a heading may say in its metadata what its section needs, as
`"slamlib": {"needs": "truth"}`. A section that is left out was executed like all others.
"""

import re
from copy import deepcopy
from dataclasses import dataclass
from itertools import count

from nbformat import NotebookNode
from nbformat.v4 import new_markdown_cell

from slamlib.dataset import DatasetError
from slamlib.report.chapters import chapter_of, is_appendix, needs, texts
from slamlib.report.execution import NotebookError
from slamlib.report.sanitize import print_once
from slamlib.textfile import quoted

HEADING_OR_CODE = re.compile(r"^(?P<fence>```|~~~).*?^(?P=fence)"
                     r"|^(?P<level>#{1,3})[ \t]+(?P<title>[^\n]+)", re.MULTILINE | re.DOTALL)
IN_CODE = re.compile(r"[\"'](#{2,3} [^\"'\\\n]+)")  # a heading that a cell will show


@dataclass(frozen=True)
class Section:
    """A heading: its level (1 is a title), number such as "3.5" (or None), title and need."""

    level: int
    number: str | None
    title: str
    needs: str | None = None


def sections_of(source, book):
    """Return the headings (list of Section) of a notebook (Path, NotebookNode), in order.

    NotebookError if the metadata of a cell has a need that is unknown or not a section's.
    """
    chapter, counts, found = chapter_of(source, book)["number"], [0, 0], []
    for cell in book.cells:
        need = needs(source, cell)
        if need and not (cell.cell_type == "markdown" and re.match("###? ", cell.source)):
            raise NotebookError(f"{source.name}: expected a Markdown cell that begins with a "
                                f"heading ## or ### where the metadata says that it needs {need}, "
                                f"found {quoted(cell.source)}")
        for node, key in texts([cell]):
            for begin, level, title in _headings(node[key]):
                if level > 1:
                    counts = [counts[0] + 1, 0] if level == 2 else [counts[0], counts[1] + 1]
                number = ".".join(map(str, [chapter, *counts[:level - 1]])) if chapter else None
                found.append(Section(level, number, title, None if begin else need))
    return found


def shown(books, has, leave_out):
    """Return the books (dict from Path to NotebookNode) without what a report leaves out.

    These are sections that need what the datasets do not have, `has` (a set by
    `chapters.available`), and what `leave_out` names, as in `to_execute`.
    """
    left_out, result = {_key(entry): place for entry, place in leave_out.items()}, {}

    def reason(section):
        """Return why a section is left out (str), "" without a reason, or None if it is shown."""
        if section.needs not in {None, *has}:
            return f"no dataset has {section.needs}"
        return next((left_out[key] for key in (_key(section.number), _key(section.title))
                     if section.level > 1 and key in left_out), None)

    for source, book in books.items():
        if _is_left_out(source, book, left_out):
            print_once(f"{source.stem}: left out")
            continue
        dropped = set()
        for index, section in enumerate(sections_of(source, book)):
            if (why := reason(section)) is not None:
                dropped.add(index)
            if why:
                print_once(f"{source.stem}: section '{section.title}' left out ({why})")
        result[source] = _without_sections(book, dropped)
    return result


def to_execute(books, leave_out):
    """Return the books without those appendices that are left out: only chapters write results.

    Parameters
    ----------
    books : dict from Path to NotebookNode, all that there are.
    leave_out : dict from what is left out to where this is asked for (str), such as
        "report.toml, line 3", or "" where it need not exist. It is a chapter by its number ("2" or
        "B"), or a section by its number ("3.5") or title. Sections are numbered as where nothing is
        left out, neither by this dict nor for lack of data.

    Raises
    ------
    DatasetError : nothing has this number or title. Headings that a cell will show count where its
        code names them.
    """
    for entry, place in leave_out.items():
        if place:
            _require_known(books, entry, place)
    left_out = {_key(entry) for entry in leave_out}
    return {source: book for source, book in books.items()
            if not (is_appendix(chapter_of(source, book))
                    and _is_left_out(source, book, left_out))}


def _require_known(books, entry, place):
    """Raise DatasetError, which begins with `place`, if no chapter or section is called `entry`."""
    chapters, listed, names = [], [], set()
    for source, book in books.items():
        number = chapter_of(source, book)["number"]
        chapters += [number] if number else []
        names.add(_key(number))
        for section in sections_of(source, _announced(book)):
            if section.level > 1:
                names |= {_key(section.number), _key(section.title)}
                listed.append(f"{section.number} {section.title}" if number else section.title)
    if _key(entry) not in names - {_key(None)}:
        chapter = entry.strip().partition(".")[0]
        similar = [name for name in listed
                   if chapter in chapters and name.startswith(f"{chapter}.")]
        raise DatasetError(f"{place}: expected to leave out a chapter ({', '.join(chapters)}) or a "
                           f"section ({', '.join(similar or listed)}), found {quoted(entry)}")


def _is_left_out(source, book, left_out):
    number = chapter_of(source, book)["number"]
    return number is not None and _key(number) in left_out


def _key(name):
    """Return a number or a title (str or None) as it is compared."""
    return _plain(name or "").removesuffix(".").casefold()


def _plain(title):
    return re.sub("[*_`]", "", title).strip(" #")


def _headings(text):
    """Yield (index, level, title) of each heading of levels 1 to 3 in Markdown."""
    for found in HEADING_OR_CODE.finditer(text):
        if found["level"]:
            yield found.start(), len(found["level"]), _plain(found["title"])


def _announced(book):
    """Return a book that is not yet executed, with headings in place of the code that names any."""
    return NotebookNode(book | {"cells": [
        new_markdown_cell("\n\n".join(IN_CODE.findall(cell.source)))
        if cell.cell_type == "code" else cell for cell in book.cells]})


def _without_sections(book, dropped):
    """Return a book without the sections at the indexes `dropped` (set) in `sections_of`."""
    if not dropped:
        return book
    indexes, hidden, cells = count(), 0, []  # hidden: the level of the section left out here, or 0

    def kept(text):
        nonlocal hidden
        headings = [*_headings(text)]
        ends = [*(begin for begin, *_ in headings), len(text)]
        parts = [] if hidden else [text[:ends[0]]]
        for (begin, level, _), end in zip(headings, ends[1:]):
            index = next(indexes)
            if not hidden or level <= hidden:
                hidden = level if index in dropped else 0
            if not hidden:
                parts.append(text[begin:end])
        return "".join(parts)

    def keeps(output):
        data = output.get("data", {})
        if "text/markdown" not in data:
            return not hidden
        data["text/markdown"] = kept(data["text/markdown"])
        return data["text/markdown"].strip()

    for cell in map(deepcopy, book.cells):
        if cell.cell_type == "markdown":
            cell.source = kept(cell.source)
        elif hidden:
            cell.source = ""
        if "outputs" in cell:
            cell.outputs = [output for output in cell.outputs if keeps(output)]
        if cell.source.strip() or cell.get("outputs"):
            cells.append(cell)
    return NotebookNode(book | {"cells": cells})
