"""Numbers figures and tables without gaps, and links the text to figures, tables and equations.

A caption is a paragraph that begins with "Figure 2.3." or "Table A.3." (chapter or appendix, and
number) directly below its figure or table. Some datasets leave figures out; numbering closes these
gaps. References such as "figure 2.3", "tables A.3 and A.5", "equation 2.1" or "appendix A" become
links. Of an appendix that is left out, "(table A.3)" goes, and a sentence that begins with
"Table A.3" or "Appendix A".
"""

import re
from copy import deepcopy

from slamlib.report.chapters import chapter_of, is_appendix, texts
from slamlib.report.execution import NotebookError

CAPTION = re.compile(r"\W*(Figure|Table)\s+(\d+(?:\.\d+)?|[A-Z]\.\d+)\.(?!\d)")
TAG = re.compile(r"\\tag\*?\s*\{([^{}]*)\}")
DOTTED, WHOLE, LETTER = r"(?:\d+|(?-i:[A-Z]))\.\d+", r"\d+(?![.\d]*\d)", r"(?-i:[A-Z])\b"
LABEL = r"\d+(?:\.\d+)?|\b[A-Z]\.\d+|\b[A-Z]\b"  # each of those
AND = r"(?:,?\s+(?:and|to|or)\s+|,\s+|–)"
TEXT_PARTS = re.compile(  # code, formulas and addresses; headings; captions; references
    r"```.*?```|`[^`\n]*`|\$\$.*?\$\$|\$[^$\n]*\$|\]\([^)\n]*\)"
    r"|(?:\A|\n\s*\n)(?:#(?:(?!\n\s*\n).)*|(?P<caption>\W*(Figure|Table)\s+)"
    r"(\d+\.\d+|[A-Z]\.\d+)\.(?!\d))"
    r"|\b(?i:(?P<kind>figure|table|equation)s?\s+"
    rf"(?P<labels>{DOTTED}(?:{AND}{DOTTED})*|{WHOLE}(?:{AND}{WHOLE})*))"
    rf"|\b(?i:appendi(?:x|ces)\s+(?P<letters>{LETTER}(?:{AND}{LETTER})*))", re.DOTALL)


def _to_absent(letters):
    """Return a Pattern of references to appendices whose letter is not in `letters`."""
    absent = f"(?![{letters} ])[A-Z]"
    label = rf"(?:(?i:figure|table)s?\s+{absent}\.\d+|(?i:appendix)\s+{absent}\b(?!\s+of\b))"
    sentence = rf"(?=[A-Z]){label}(?:(?!\n\n).)*?[.?!]"
    return re.compile(rf"\s*\({label}\)|(?:\A|(?<=\n\n)){sentence}(?:[^\S\n]+|(?=\n|\Z))"
                      rf"|(?<=[.?!])(?:[^\S\n]+|\n(?=\S)){sentence}(?=\s|\Z)", re.DOTALL)


def numbered(books, whole=None):
    """Return copies of executed books (dict from Path to NotebookNode), numbered and with links.

    `whole` has also what `books` leaves out. A reference to an omitted part becomes plain text,
    marked "left out" if another part has its number now.

    Raises
    ------
    NotebookError : a caption is not directly below its figure or table, a number occurs twice, or
        a reference to a chapter of the report has no target.
    """
    books = {source: deepcopy(book) for source, book in books.items()}
    targets = _targets(books)
    taken = {(kind, number) for (kind, _), (_, number) in targets.items()}
    absent = {(kind, label): f"{number} (left out)" if (kind, number) in taken else number
              for (kind, label), (_, number) in _targets(whole or {}).items()
              if (kind, label) not in targets}
    chapters = {label.partition(".")[0] for _, label in targets if "." in label} | {
        chapter_of(source, book)["number"] for source, book in (whole or books).items()}
    to_absent = _to_absent("".join(label for kind, label in targets if kind == "appendix"))
    for source, book in books.items():
        for node, key in texts(book.cells):
            text = to_absent.sub("", node[key])
            node[key] = _linked(text, source, targets, absent, chapters)
    return books


def _targets(books):
    """Return {(kind, label): (source, number)} of all captions, equations and appendices."""
    targets = {}
    for source, book in books.items():
        for kind, label, number in _numbers(source, book):
            if (kind, label) in targets:
                raise NotebookError(f"{source.name}: {kind} {label} occurs twice")
            targets[kind, label] = source, number
    return targets


def _numbers(source, book):
    """Yield (kind, label, new number) for each caption and each equation, and for an appendix."""
    chapter = chapter_of(source, book)
    if is_appendix(chapter):
        yield "appendix", chapter["number"], chapter["number"]
    count = {"figure": 0, "table": 0}
    for above, kind, label in _captions(book):
        if above != kind:
            raise NotebookError(f"{source.name}: the caption of {kind} {label} is not "
                                f"directly below a {kind}")
        count[kind] += 1
        yield kind, label, f"{label.partition('.')[0]}.{count[kind]}"
    for tag in (tag.strip() for node, key in texts(book.cells) for tag in TAG.findall(node[key])):
        yield "equation", tag, tag


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


def _linked(text, source, targets, absent, chapters):
    """Return Markdown with the final numbers in its captions and with links for its references.

    `chapters` are the numbers of those that are executed: what is not there is refused.
    """
    def link(kind, label):
        if (kind, label) in targets:
            target, number = targets[kind, label]
            anchor = {"equation": f"#eq-{number}", "appendix": ""}.get(kind, f"#{kind}-{number}")
            return f"[{number}]({'' if target == source and anchor else target.name}{anchor})"
        if (kind, label) in absent:
            return absent[kind, label]
        if "." in label and label.partition(".")[0] in chapters:
            raise NotebookError(
                f"{source.name}: the text refers to {kind} {label}, which does not exist")
        return label  # of a chapter that is not in the report, or of another text

    def replaced(part):
        if part["caption"]:
            return part[0].removesuffix(f"{part[3]}.") + f"{targets[part[2].lower(), part[3]][1]}."
        labels = part["labels"] or part["letters"]
        if not labels:
            return part[0]
        kind = part["kind"].lower() if part["kind"] else "appendix"
        return part[0].removesuffix(labels) + re.sub(
            LABEL, lambda label: link(kind, label[0]), labels)

    return TEXT_PARTS.sub(replaced, text)
