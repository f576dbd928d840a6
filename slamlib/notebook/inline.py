"""Puts figures as compact SVG into HTML pages, with sentences at their points.

Pages show figures as pictures, which do not react to the pointer. A figure with sentences at points
(`tell`) is put into the page itself, as another output of the same cell.
"""

import re
from hashlib import sha256
from html import escape

from slamlib.notebook import plotting

POINTING_RADIUS = 5.0        # points, radius of the area around a place that shows its sentence
MAX_ENLARGEMENT = 1.4        # of a figure, where the page has room for it
TELLING_ID = "telling"       # id of these areas


def tell(ax, places, sentences, name):
    """Give each of places (n, 2) a sentence (str) that HTML pages show under the pointer.

    `name` (str) is the figure's, for screen readers. One call a figure.
    """
    ax.plot(*places.T, "o", markersize=2 * POINTING_RADIUS, alpha=0, gid=TELLING_ID, zorder=20)
    ax.figure.telling = list(sentences), name


def outputs(fig, pictures):
    """Outputs (dict of str) of a figure by MIME type: its pictures, and HTML if it is interactive.

    The HTML of a figure with controls is its attribute `moving` (`live.live_figure`); `pictures`
    are by `plotting.svg_pictures`.
    """
    if not pictures:
        return pictures
    if moving := getattr(fig, "moving", None):
        return {**pictures, "text/html": moving}
    if not getattr(fig, "telling", None):
        return pictures
    sentences, name = fig.telling
    both = "".join(_svg(_told(with_own_ids(pictures[key]), sentences), kind, name)
                   for key, kind in ((plotting.WIDE, "wide"), (plotting.NARROW, "narrow")))
    return {**pictures, "text/html": f'<figure class="inline">{both}</figure>'}


def with_own_ids(svg):
    """An SVG (str) by matplotlib, shortened, with ids that no other picture of an HTML page has.

    Ids without a reference are left out, TELLING_ID stays, all others begin with a hash of the
    picture.
    """
    svg = shortened(re.sub(r"<metadata>.*?</metadata>|<style.*?</style>|<!--.*?-->", "",
                           svg[svg.index("<svg"):], flags=re.DOTALL).replace("xlink:href", "href"))
    used = {name for pair in re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', svg) for name in pair}
    own = f"i{sha256(svg.encode()).hexdigest()[:8]}-"
    svg = re.sub(r' id="([^"]*)"', lambda found: found[0] if found[1] == TELLING_ID else
                 f' id="{own}{found[1]}"' if found[1] in used else "", svg)
    return re.sub(r'(href="|url\()#', rf"\1#{own}", svg)


def shortened(svg):
    """An SVG (str) or a part of one with short numbers, and no space between its elements."""
    svg = re.sub(r' transform="rotate\(-0 [^)]*\)"', "", svg)
    svg = re.sub(r'(?<= (?:d|x|y)=")[^"]*', lambda part: _short(part[0]), svg)
    svg = re.sub(r'(?<=translate\()[^)]*', lambda part: _short(part[0]), svg)
    svg = re.sub(r'(?<= style=")[^"]*', lambda part: re.sub(r"([:;])\s+", r"\1", part[0]), svg)
    return re.sub(r">\s+<", "><", svg).strip()


def _short(numbers):
    """A text with its numbers rounded, to two digits behind the point below 10 and one above."""
    def rounded(number):
        value = float(number[0])
        return f"{round(value, 2 if abs(value) < 10 else 1):g}"
    numbers = re.sub(r"-?\d+\.\d+", rounded, " ".join(numbers.split()))
    return re.sub(r" ?([A-Za-z]) ?", r"\1", numbers)


def _told(svg, sentences):
    """An SVG with the areas of its points, each with the sentence in a title."""
    group = re.search(rf'<g id="{TELLING_ID}">(.*?)</g></g>', svg, re.DOTALL)
    places = re.findall(r'<use [^>]*?x="([^"]+)" y="([^"]+)"', group[1])
    areas = "".join(
        f'<circle cx="{x}" cy="{y}" r="{POINTING_RADIUS:g}">'
        f"<title>{escape(sentence)}</title></circle>"
        for (x, y), sentence in zip(places, sentences, strict=True))
    return svg[:group.start()] + f"<g>{areas}</g>" + svg[group.end():]


def _svg(svg, kind, name):
    """An SVG element of a class, with a name and its width; lines end and join as matplotlib's."""
    box, width = re.search(r'viewBox="[^"]*"', svg)[0], re.search(r'width="([\d.]+)pt"', svg)[1]
    return (f'<svg class="{kind}" {box} role="img" aria-label="{escape(name)}" '
            f'style="max-width:{MAX_ENLARGEMENT * float(width):.0f}pt;stroke-linejoin:round;'
            f'stroke-linecap:butt">{svg[svg.index(">") + 1:]}')
