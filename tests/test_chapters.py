"""The notebooks as they are written, and what they show and do not check themselves."""

import re
import symtable

import nbformat
import pytest
from conftest import ROOT

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
CHAPTERS = [source for source in NOTEBOOKS if source.name[0].isdigit()]
LABEL = r"(?:\d+\.\d+|[A-Z]\.\d+|\d\b|[A-Z]\b)"
REFERENCE = re.compile(  # to a label such as 2.3 or A, which begins with its chapter
    r"(?i:(chapter|section|table|figure|equation|appendix)s?)\s"
    rf"({LABEL}(?:(?:,| and| to)+ {LABEL})*)")
REMARK = re.compile(r"\[\([^\]]*\)\]\([^)]*\.ipynb\)")  # the report has it with its notebook only


def cells_of(source):
    return [cell for cell in nbformat.read(source, as_version=4).cells if cell.cell_type == "code"]


def has(cell, tag):
    return tag in cell.metadata.get("tags", ())


@pytest.mark.parametrize("source", CHAPTERS, ids=lambda path: path.stem)
def test_sections_figures_and_tables_are_numbered_in_order_and_try_it_is_last(source):
    cells = nbformat.read(source, as_version=4).cells
    text = "\n".join(cell.source for cell in cells)
    headings = re.findall("(?m)^## (.+)$", text)
    assert headings[-1] == "Try it"
    sections = [heading.split()[0] for heading in headings
                if heading not in ("References", "Try it")]
    for kind, found in (("Section", sections), ("Figure", numbers_of("Figure", text)),
                        ("Table", numbers_of("Table", text))):
        assert found == [f"{source.name[0]}.{n}" for n in range(1, len(found) + 1)], kind
    first = next(i for i, cell in enumerate(cells) if cell.source.startswith("## Try it"))
    assert [has(cell, "lab-only") for cell in cells] == [i >= first for i in range(len(cells))]


@pytest.mark.parametrize("source", NOTEBOOKS, ids=lambda path: path.stem)
def test_no_chapter_speaks_of_one_that_may_be_left_out_where_it_is_not(source):
    books = {path.name[0]: nbformat.read(path, as_version=4) for path in NOTEBOOKS}
    needs = {key: book.metadata.get("slamlib", {}).get("needs") for key, book in books.items()}
    own = source.name[0]
    text = "\n".join(cell.source for cell in books[own].cells
                     if cell.cell_type == "markdown" and not has(cell, "lab-only"))
    referred = set()
    for kind, labels in REFERENCE.findall(REMARK.sub("", text)):
        for label in re.findall(LABEL, labels):
            if "." in label or kind.lower() in ("chapter", "appendix"):
                referred.add(label[0])
    assert referred >= {own} and {needs[key] for key in referred} <= {None, needs[own]}


def numbers_of(kind, text):
    """Numbers of the captions of figures or tables, each of which the text refers to."""
    numbers = re.findall(rf'^(?:.*")?{kind} (\d+\.\d+)\. ', text, re.MULTILINE)
    for number in numbers:
        assert re.search(rf"(?i){kind}s? (\S+ and )?{re.escape(number)}(?!\. \S)", text), number
    return numbers


@pytest.mark.parametrize("source", CHAPTERS, ids=lambda path: path.stem)
def test_what_pages_fold_is_collapsed_in_jupyterlab(source):
    for cell in cells_of(source):
        collapsed = cell.metadata.get("jupyter", {}).get("source_hidden", False)
        assert collapsed == has(cell, "hide-input")


def names_of(source):
    """Global names that code binds and uses, in its functions too: two sets."""
    whole = symtable.symtable(source, "cell", "exec")
    bound = {each.get_name() for each in whole.get_symbols()
             if each.is_assigned() or each.is_imported()}
    used = {each.get_name() for each in whole.get_symbols() if each.is_referenced()}
    tables = whole.get_children()
    while tables:
        table = tables.pop()
        used |= {each.get_name() for each in table.get_symbols() if each.is_global()}
        tables += table.get_children()
    return bound, used


@pytest.mark.parametrize("source", CHAPTERS, ids=lambda path: path.stem)
def test_what_is_shown_runs_without_what_is_hidden(source):
    hidden = set()
    shown = set()
    for cell in cells_of(source):
        bound, used = names_of(cell.source)
        if has(cell, "hide-input"):
            hidden |= bound - shown
        elif not has(cell, "lab-only"):
            shown |= bound
            assert not (used - shown) & hidden
