"""Numbers of figures, tables and equations: counted as they are shown, and linked where they are named.

A caption is a paragraph that begins with "Figure 2.3." or "Table 2.3.", chapter and number, directly
below what it describes. What a dataset cannot show would leave gaps in the numbers: they are closed.
Running text names "figure 2.3", "tables 2.3 and 2.5" or "equation 2.1", which become links.
"""

import re
from copy import deepcopy

from slamlib.execution import NotebookError

CAPTION = re.compile(r"\W*(Figure|Table)\s+(\d+(?:\.\d+)?)\.(?!\d)")
TAG = re.compile(r"\\tag\*?\s*\{([^{}]*)\}")
DOTTED, WHOLE, AND = r"\d+\.\d+", r"\d+(?![.\d]*\d)", r"(?:,?\s+(?:and|to|or)\s+|,\s+|–)"
NAMED = re.compile(rf"\b(figure|table|equation)s?\s+({DOTTED}(?:{AND}{DOTTED})*|{WHOLE}(?:{AND}{WHOLE})*)",
                   re.IGNORECASE)
LITERAL = re.compile(r"(```.*?```|`[^`\n]*`|\$\$.*?\$\$|\$[^$\n]*\$|\]\([^)\n]*\))", re.DOTALL)


def numbered(books):
    """The books with figures and tables numbered without gaps, and with links to what text names.

    Parameters
    ----------
    books : dict from Path to executed NotebookNode; they are left as they are.

    Returns
    -------
    dict from Path to NotebookNode.

    Raises
    ------
    NotebookError
        A caption without its figure or table directly above it, two figures, tables or equations of one
        number, or one that is named in the text (by chapter and number) and not there.
    """
    books = {source: deepcopy(book) for source, book in books.items()}
    places = {}                                             # (kind, label): source, number, anchor

    def place(source, kind, label, number, anchor):
        if (kind, label) in places:
            raise NotebookError(f"{source.name}: {kind} {label} is there twice")
        places[kind, label] = source, number, anchor

    for source, book in books.items():
        count = {"figure": 0, "table": 0}
        for above, kind, label in _captions(book):
            if above != kind:
                raise NotebookError(f"{source.name}: the caption of {kind} {label} does not stand directly "
                                    f"below a {kind}")
            count[kind] += 1
            number = f"{label.partition('.')[0]}.{count[kind]}"
            place(source, kind, label, number, f"{kind}-{number}")
        for tag in (tag.strip() for text in _texts(book) for tag in TAG.findall(text[0][text[1]])):
            place(source, "equation", tag, tag, f"eq-{tag}")
    for source, book in books.items():
        for holder, key in _texts(book):
            holder[key] = _linked(holder[key], source, places)
    return books


def _texts(book):
    """All Markdown of a book, in cells and outputs, as (what holds it, key)."""
    texts = []
    for cell in book.cells:
        if cell.cell_type == "markdown":
            texts.append((cell, "source"))
        texts += [(output.data, "text/markdown") for output in cell.get("outputs", ())
                  if "text/markdown" in output.get("data", {})]
    return texts


def _captions(book):
    """Yield for each caption by chapter and number what is above it, "figure", "table" or another
    thing, its kind and its label.
    """
    above = None
    for cell in book.cells:
        shown = [cell.source] if cell.cell_type == "markdown" else [None]     # None: no text
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            picture = any(kind.startswith("image/") for kind in data)
            shown.append("figure" if picture else data.get("text/markdown"))
        for text in shown:
            text = re.sub("```.*?```", "", text or "", flags=re.DOTALL)
            for block in re.split(r"\n\s*\n", text.strip()):
                caption = CAPTION.match(block)
                if caption and "." in caption[2]:
                    yield above, caption[1].lower(), caption[2]
                above = "table" if block.startswith("|") else block


def _linked(text, source, places):
    """Text with its own numbers in captions, and links where it names figures, tables and equations."""
    chapters = {label.partition(".")[0] for _, label in places if "." in label}

    def links(named):
        kind, labels = named[1].lower(), named[2]

        def link(label):
            if (kind, label[0]) in places:
                where, number, anchor = places[kind, label[0]]
                return f"[{number}]({'' if where == source else where.name}#{anchor})"
            if label[1] and label[0].partition(".")[0] in chapters:
                raise NotebookError(f"{source.name}: the text names {kind} {label[0]}, which is not there")
            return label[0]                                 # of a chapter that is not here, or another text

        return named[0].removesuffix(labels) + re.sub(r"\d+(\.\d+)?", link, labels)

    def block(text):
        if text.startswith("#"):                            # a heading holds no links
            return text
        caption = CAPTION.match(text)
        if not caption or "." not in caption[2]:
            return NAMED.sub(links, text)
        number = places[caption[1].lower(), caption[2]][1]
        return text[:caption.start(2)] + number + NAMED.sub(links, text[caption.end(2):])

    parts = LITERAL.split(text)
    for i in range(0, len(parts), 2):
        first, *rest = re.split(r"(\n\s*\n)", parts[i])
        first = block(first) if i == 0 else NAMED.sub(links, first)
        parts[i] = first + "".join(map(block, rest))
    return "".join(parts)
