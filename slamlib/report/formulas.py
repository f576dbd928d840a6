"""Converts TeX formulas with pandoc; names a formula that cannot be converted and loses none."""

import json
import re
from functools import cache

import pypandoc

from slamlib.report.execution import NotebookError

LOST = re.compile(r"\\(hline|cline|boxed|cancel|color|textcolor)\b|\{array\}\s*\{[^}]*\|")
WARNING = re.compile(
    r"Could not convert TeX math (.*?), rendering as TeX:(.*?)\nFailing because", re.DOTALL)


def set_formulas(formulas, target, options, error):
    """Return formulas (list of str) in another format, by one call of pandoc (0.1 s or more).

    Parameters
    ----------
    formulas : list of (str, bool), the TeX and whether it is a display formula.
    target, options : str and list of str, pandoc's name of the format, and its options.
    error : function of a formula's index and a reason (str); it returns the NotebookError to raise
        if pandoc would lose a part of the formula or cannot convert it.
    """
    if not formulas:
        return []
    blocks = []
    for number, (tex, display) in enumerate(formulas):
        if lost := LOST.search(tex):
            raise error(number, f"pandoc would lose {lost[0]} in this formula")
        kind = {"t": "DisplayMath" if display else "InlineMath"}
        blocks += [{"t": "Plain", "c": [{"t": "Math", "c": [kind, tex]}]},
                   {"t": "RawBlock", "c": [target, "\ue000"]}]
    document = {"pandoc-api-version": _api_version(), "meta": {}, "blocks": blocks}
    try:
        text = pypandoc.convert_text(json.dumps(document), target, "json",
                                     ["--wrap=none", "--fail-if-warnings", *options])
    except RuntimeError as refused:
        raise _named_formula(str(refused), formulas, error) from None
    converted = text.split("\ue000")[:-1]
    if len(converted) != len(formulas):
        raise NotebookError(f"pandoc lost some of {len(formulas)} formulas")
    return converted


@cache
def _api_version():
    """Return the version number that pandoc requires in a JSON document."""
    return json.loads(pypandoc.convert_text("", "json", "markdown"))["pandoc-api-version"]


def _named_formula(message, formulas, error):
    """Return the error for pandoc's message; it names the formula if the message does."""
    found = WARNING.search(message)
    number = next((n for n, (tex, _) in enumerate(formulas) if found and tex == found[1]), None)
    if number is None:
        return NotebookError(f"pandoc cannot set a formula:\n{message.strip()}")
    reason = re.search(r"^\s*((?:unexpected|expecting).*?)\s*$", found[2], re.MULTILINE)
    return error(number, f"pandoc cannot set this formula, {reason[1] if reason else 'not TeX'}")
