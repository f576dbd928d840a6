"""Text of the report's opening in Markdown: names as they are, lists, tables, numbers."""

import re
import unicodedata


def plain(text):
    """Return text (str) with the characters escaped that Markdown or HTML would interpret.

    Names from folders and files pass it or `code`. A space replaces a control character.
    """
    return re.sub(r"[^\w\s.,:;/+-]|(?<![^\W_])_|_(?![^\W_])",
                  lambda sign: f"&#{ord(sign[0])};", _seen(text))


def code(text):
    """Return text (str), such as a path, as code in Markdown, whatever characters it has."""
    text = _seen(text)
    fence = "`" * (1 + max(map(len, re.findall("`+", text)), default=0))
    return f"{fence} {text} {fence}" if len(fence) > 1 else f"`{text}`"


def _seen(text):
    return "".join(" " if unicodedata.category(sign)[0] == "C" else sign for sign in text)


def listed(names):
    """Return names as a str, "a, b and c"."""
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def table_text(header, rows, texts=1):
    """Return a table in Markdown (str).

    `header` is a list of c str, `rows` a list of such lists. The first `texts` columns are aligned
    left as text, the others right. Of consecutive rows with the same first cell only the first row
    shows it.
    """
    above = [None, *(row[0] for row in rows)]
    grouped = [["" if row[0] == first else row[0], *row[1:]]
               for first, row in zip(above, rows, strict=False)]
    lines = [header, ["---"] * texts + ["---:"] * (len(header) - texts), *grouped]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def with_unit(value, unit):
    """Return a value with three significant digits and its unit (str), below 1 with a milli."""
    value, unit = (value, unit) if abs(value) >= 1 else (1e3 * value, f"m{unit}")
    digits = f"{value:{',.0f' if abs(value) >= 100 else '#.3g'}}".removesuffix(".")
    return f"{digits}\u00a0{unit}"
