"""Numbers figures and tables without gaps, and links the text to figures, tables and equations.

A caption is a paragraph that begins with "Figure 2.3." or "Table 2.3." (chapter and number)
directly below its figure or table. Some datasets leave figures out; numbering closes these gaps.
References such as "figure 2.3", "tables 2.3 and 2.5" or "equation 2.1" become links.
"""

import re
from copy import deepcopy

from slamlib.report.execution import NotebookError

CAPTION = re.compile(r"\W*(Figure|Table)\s+(\d+(?:\.\d+)?)\.(?!\d)")
TAG = re.compile(r"\\tag\*?\s*\{([^{}]*)\}")
DOTTED, WHOLE, AND = r"\d+\.\d+", r"\d+(?![.\d]*\d)", r"(?:,?\s+(?:and|to|or)\s+|,\s+|–)"
PARTS = re.compile(  # code, formulas and addresses; headings; captions; references
    r"```.*?```|`[^`\n]*`|\$\$.*?\$\$|\$[^$\n]*\$|\]\([^)\n]*\)"
    r"|(?:\A|\n\s*\n)(?:#(?:(?!\n\s*\n).)*|(?P<caption>\W*(Figure|Table)\s+)(\d+\.\d+)\.(?!\d))"
    r"|\b(?i:(?P<kind>figure|table|equation)s?\s+"
    rf"(?P<labels>{DOTTED}(?:{AND}{DOTTED})*|{WHOLE}(?:{AND}{WHOLE})*))", re.DOTALL)


def numbered(books):
    """Return copies of executed books (dict from Path to NotebookNode), numbered and with links.

    NotebookError if a caption is not directly below its figure or table, if a number occurs twice,
    or if a reference to a chapter of the report has no target.
    """
    books = {source: deepcopy(book) for source, book in books.items()}
    targets = {}  # (kind, label) -> (source, number)
    for source, book in books.items():
        for kind, label, number in _numbers(source, book):
            if (kind, label) in targets:
                raise NotebookError(f"{source.name}: {kind} {label} occurs twice")
            targets[kind, label] = source, number
    for source, book in books.items():
        for node, key in _texts(book):
            node[key] = _linked(node[key], source, targets)
    return books


def _numbers(source, book):
    """Yield (kind, label, new number) for each caption and each equation."""
    count = {"figure": 0, "table": 0}
    for above, kind, label in _captions(book):
        if above != kind:
            raise NotebookError(f"{source.name}: the caption of {kind} {label} is not "
                                f"directly below a {kind}")
        count[kind] += 1
        yield kind, label, f"{label.partition('.')[0]}.{count[kind]}"
    for tag in (tag.strip() for node, key in _texts(book) for tag in TAG.findall(node[key])):
        yield "equation", tag, tag


def _texts(book):
    """Yield (dict, key) for each text in Markdown, in cells and outputs."""
    for cell in book.cells:
        if cell.cell_type == "markdown":
            yield cell, "source"
        for output in cell.get("outputs", ()):
            if "text/markdown" in output.get("data", {}):
                yield output.data, "text/markdown"


def _captions(book):
    """Yield (above, kind, label) for each caption; `above` is "figure", "table" or other text."""
    above = None
    for cell in book.cells:
        shown = [cell.source if cell.cell_type == "markdown" else None]
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


def _linked(text, source, targets):
    """Return Markdown with the final numbers in its captions and with links for its references."""
    chapters = {label.partition(".")[0] for _, label in targets if "." in label}

    def link(kind, label):
        if (kind, label) in targets:
            target, number = targets[kind, label]
            anchor = f"{'eq' if kind == 'equation' else kind}-{number}"
            return f"[{number}]({'' if target == source else target.name}#{anchor})"
        if "." in label and label.partition(".")[0] in chapters:
            raise NotebookError(
                f"{source.name}: the text refers to {kind} {label}, which does not exist")
        return label  # of a chapter that is not in the report, or of another text

    def replaced(part):
        if part["caption"]:
            return part[0].removesuffix(f"{part[3]}.") + f"{targets[part[2].lower(), part[3]][1]}."
        if not part["labels"]:
            return part[0]
        return part[0].removesuffix(part["labels"]) + re.sub(
            r"\d+(\.\d+)?", lambda label: link(part["kind"].lower(), label[0]), part["labels"])

    return PARTS.sub(replaced, text)
