"""HTML of cells, by an allow-list: nothing in it runs, loads or sends anything.

What Markdown cells and outputs hold passes `sanitized` before it is put into a page or the PDF.
An element, a script or an address that is not allowed is refused; what only changes the looks is
left out, and a notice says so.
"""

import re
import sys
from collections import defaultdict
from functools import cache
from html.parser import HTMLParser

import nh3

from slamlib.report.execution import NotebookError

# What is allowed: names of elements and of attributes.
ELEMENTS = nh3.ALLOWED_TAGS | set(
    "tfoot section figure figcaption form fieldset legend label input select option output "
    "progress meter svg g defs symbol use path rect circle ellipse line polyline polygon text "
    "tspan title desc clipPath mask linearGradient radialGradient stop pattern marker image"
    .split()) - {"area", "map"}
ATTRIBUTES = set(
    "id class style title lang dir role hidden align valign width height border alt href src open "
    "colspan rowspan scope span headers start reversed value datetime rel target "
    "type min max step selected checked disabled autocomplete for "
    "viewBox preserveAspectRatio version xmlns xmlns:xlink xlink:href d x y x1 x2 y1 y2 dx dy "
    "cx cy r rx ry fx fy "
    "points transform offset pathLength textLength refX refY orient markerWidth markerHeight "
    "markerUnits clipPathUnits maskUnits gradientUnits gradientTransform spreadMethod "
    "patternUnits patternTransform color fill fill-opacity fill-rule stroke stroke-width "
    "stroke-opacity stroke-linecap stroke-linejoin stroke-miterlimit stroke-dasharray "
    "stroke-dashoffset opacity stop-color stop-opacity clip-path clip-rule mask marker-start "
    "marker-mid marker-end display visibility font-family font-size font-style font-weight "
    "text-anchor dominant-baseline".split())
ADDRESSES = {"href", "xlink:href", "src"}
# A relative address, too.
LINK_PATTERN = re.compile(r"(?:https?|mailto):|[^:]*(?:[/?#]|\Z)", re.IGNORECASE)
PICTURE_DATA = re.compile(r"data:image/[\w.+-]+[;,]", re.IGNORECASE)
STYLED = {"style", "color", "fill", "stroke", "stop-color", "clip-path", "mask", "marker-start",
          "marker-mid", "marker-end"}  # hold CSS, in which a function could load something
CALLED = re.compile(r"([\w-]*)\(\s*[\"']?(#?)")
HARMLESS = {"", "rgb", "rgba", "hsl", "hsla", "calc", "min", "max", "var", "matrix", "translate",
            "scale", "rotate", "path", "linear-gradient", "radial-gradient"}
ACTIVE = ADDRESSES | STYLED | {"action", "background", "data", "formaction", "http-equiv", "ping",
                               "poster", "srcdoc", "srcset"}  # never left out without an error
MAX_VALUE = 60  # characters of an attribute's value in a message


def sanitized(text, notebook, section=""):
    """Return HTML (str) of a cell as pages show it. NotebookError if something in it is refused.

    `notebook` and `section` (str) are the file's name and the heading above, for the messages.
    """
    clean = cleaned(text)
    kept = _tags(clean)
    for (element, attribute), values in _tags(text).items():
        kept_values = kept.get((element, attribute), [])
        if len(kept_values) >= len(values):
            continue
        value = next((value for value in values if value not in kept_values), values[-1])
        what = f'<{element} {attribute}="{value[:MAX_VALUE]}">' if attribute else f"<{element}>"
        headings = re.findall(r"<h\d[^>]*>(.*?)</h\d>",
                              text[:text.lower().find(f"<{element}")], re.DOTALL)
        place = place_of(notebook, re.sub("<[^>]*>|[\ue000-\uf8ff]", "", headings[-1])
                         if headings else section)
        if element != "style" and (
                not attribute or attribute in ACTIVE or attribute.startswith("on")):
            raise NotebookError(f"{place}: the report cannot show {what}: it holds text, tables, "
                                "links and the notebook's own pictures, and nothing that runs, "
                                "loads or sends")
        print_once(f"{place}: the report leaves out {what}, which could only change its looks")
    return clean


def cleaned(text):
    """Return HTML (str) without what is not allowed."""
    return nh3.clean(text, tags=ELEMENTS, attributes={"*": ATTRIBUTES}, link_rel=None,
                     url_schemes={"http", "https", "mailto", "data"}, attribute_filter=_allowed,
                     generic_attribute_prefixes={"aria-", "data-"})


def place_of(notebook, section):
    """Return how a message names a section (str or "") of a notebook (str, name of the file)."""
    return notebook + (f", section '{section}'" if section else "")


@cache
def print_once(sentence):
    """Print a sentence (str) to stderr, unless this process has printed it before."""
    print(sentence, file=sys.stderr)


def _allowed(element, attribute, value):
    """Return the value of an attribute, or None if it could run or load something."""
    if attribute in ADDRESSES and element == "img":
        allowed = PICTURE_DATA.match(value)
    elif attribute in ADDRESSES:
        allowed = value.startswith("#") or (
            element == "a" and LINK_PATTERN.match(value)
            or element == "image" and PICTURE_DATA.match(value))
    elif attribute in STYLED:
        allowed = "\\" not in value and all(
            inside if name.lower() == "url" else name.lower() in HARMLESS
            for name, inside in CALLED.findall(value))
    else:
        allowed = True
    return value if allowed else None


def _tags(text):
    """Return {(element, attribute): values} of HTML (str), with attribute "" for elements."""
    found = defaultdict(list)

    class Tags(HTMLParser):
        parse_marked_section = HTMLParser.parse_bogus_comment  # as browsers; it knows few kinds

        def handle_starttag(self, tag, attrs):
            found[tag, ""].append("")
            for name, value in attrs:
                found[tag, name].append(value or "")

    parser = Tags()
    parser.feed(text)
    parser.close()
    return found
