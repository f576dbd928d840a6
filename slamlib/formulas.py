"""Formulas in TeX, set by pandoc: none may be lost, and one that cannot be set is named with its place."""

import json
import re
from functools import cache

import pypandoc

from slamlib.execution import NotebookError

LOST = re.compile(r"\\(hline|cline|boxed|cancel|color|textcolor)\b|\{array\}\s*\{[^}]*\|")
REFUSED = re.compile(r"Could not convert TeX math (.*?), rendering as TeX:(.*?)\nFailing because", re.DOTALL)


def set_formulas(formulas, to, options, refusal):
    """Formulas in another format: all in one call of pandoc, which takes 0.1 s or more.

    Parameters
    ----------
    formulas : list of (TeX, display: bool).
    to, options : pandoc's name of the format, and options.
    refusal : function of a formula's number in the list, and a reason, that makes the error to raise.

    Raises
    ------
    NotebookError : pandoc would lose a part of a formula, or cannot set it.
    """
    blocks = []
    for number, (tex, display) in enumerate(formulas):
        if lost := LOST.search(tex):
            raise refusal(number, f"{lost[0]} would be lost in this formula")
        kind = {"t": "DisplayMath" if display else "InlineMath"}
        blocks += [{"t": "Plain", "c": [{"t": "Math", "c": [kind, tex]}]},
                   {"t": "RawBlock", "c": [to, "\ue000"]}]
    document = {"pandoc-api-version": _api_version(), "meta": {}, "blocks": blocks}
    try:
        text = pypandoc.convert_text(json.dumps(document), to, "json",
                                     ["--wrap=none", "--fail-if-warnings", *options])
    except RuntimeError as error:
        raise _refused(str(error), formulas, refusal) from None
    done = text.split("\ue000")[:-1]
    if len(done) != len(formulas):
        raise NotebookError(f"of {len(formulas)} formulas pandoc lost some")
    return done


@cache
def _api_version():
    """The version that pandoc wants in a document in JSON."""
    return json.loads(pypandoc.convert_text("", "json", "markdown"))["pandoc-api-version"]


def _refused(told, formulas, refusal):
    """The error for what pandoc told, in one line if it named the formula."""
    found = REFUSED.search(told)
    number = next((n for n, (tex, _) in enumerate(formulas) if found and tex == found[1]), None)
    if number is None:
        return NotebookError(f"pandoc cannot set a formula:\n{told.strip()}")
    lines = [line.strip() for line in found[2].splitlines()]
    reason = next((line for line in lines if line.startswith(("unexpected", "expecting"))), "not TeX")
    return refusal(number, f"pandoc cannot set this formula, {reason}")
