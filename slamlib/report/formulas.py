"""Converts TeX formulas with pandoc, and reports those that pandoc cannot convert."""

import json
import re
from dataclasses import dataclass
from functools import cache

import pypandoc

from slamlib.report.execution import NotebookError
from slamlib.report.sanitize import place_of

LOST = re.compile(r"\\(hline|cline|boxed|cancel|color|textcolor)\b|\{array\}\s*\{[^}]*\|")
WARNING = re.compile(
    r"Could not convert TeX math (.*?), rendering as TeX:(.*?)\nFailing because", re.DOTALL)


@dataclass(frozen=True)
class Formula:
    """A formula of a notebook."""

    tex: str
    display: bool
    number: str  # in the tag of a display formula, or ""
    anchor: str  # of a formula that has a number, or ""
    notebook: str  # name of the file
    section: str  # the heading above, or ""

    def error(self, reason):
        """Return the NotebookError that names this formula, for a reason (str)."""
        return NotebookError(f"{place_of(self.notebook, self.section)}: {reason}:\n    {self.tex}")


def set_formulas(formulas, target, *options):
    """Return formulas (list of str) in another format, by one call of pandoc (0.1 s or more).

    NotebookError if pandoc would lose a part of a formula or cannot convert it.

    Parameters
    ----------
    formulas : list of Formula.
    target, *options : str, pandoc's name of the format, and its options.
    """
    if not formulas:
        return []
    blocks = []
    for formula in formulas:
        if lost := LOST.search(formula.tex):
            raise formula.error(f"pandoc would lose {lost[0]} in this formula")
        kind = {"t": "DisplayMath" if formula.display else "InlineMath"}
        blocks += [{"t": "Plain", "c": [{"t": "Math", "c": [kind, formula.tex]}]},
                   {"t": "RawBlock", "c": [target, "\ue000"]}]
    document = {"pandoc-api-version": _api_version(), "meta": {}, "blocks": blocks}
    try:
        text = pypandoc.convert_text(json.dumps(document), target, "json",
                                     ["--wrap=none", "--fail-if-warnings", *options])
    except RuntimeError as refused:
        raise _pandoc_error(str(refused), formulas) from None
    converted = text.split("\ue000")[:-1]
    if len(converted) != len(formulas):
        raise NotebookError(f"pandoc lost some of {len(formulas)} formulas")
    return converted


@cache
def _api_version():
    """Return the version number that pandoc requires in a JSON document."""
    return json.loads(pypandoc.convert_text("", "json", "markdown"))["pandoc-api-version"]


def _pandoc_error(message, formulas):
    """Return the NotebookError for pandoc's message; it names the formula if the message does."""
    found = WARNING.search(message)
    formula = next((each for each in formulas if found and each.tex == found[1]), None)
    if formula is None:
        return NotebookError(f"pandoc cannot set a formula:\n{message.strip()}")
    reason = re.search(r"^\s*((?:unexpected|expecting).*?)\s*$", found[2], re.MULTILINE)
    return formula.error(f"pandoc cannot set this formula, {reason[1] if reason else 'not TeX'}")
