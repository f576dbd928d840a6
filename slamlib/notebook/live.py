"""Makes figures with controls for HTML pages: drawn for a grid of values when the page is made.

The figures of all values become one set of SVG parts and, for each value, the list of its parts,
so that common parts are stored once. The page's script (`report/page.js`) shows the parts of
the values that the reader chooses. Without a script the figure of the first values stands still.
"""

import io
import json
import re
import xml.etree.ElementTree as ElementTree
from hashlib import sha256
from html import escape
from itertools import product

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.backends.backend_svg import FigureCanvasSVG

from slamlib.notebook.inline import shortened

SVG, LINK = "{http://www.w3.org/2000/svg}", "{http://www.w3.org/1999/xlink}href"
CURVE_TOLERANCE = 0.5        # points, largest difference of drawn curves from the computed ones


def live_figure(draw, controls, grid):
    """The figure by draw(**values) of the controls' values; its attribute `moving` is HTML (str).

    Parameters
    ----------
    draw : function of values by name that returns a figure. Its attribute `said` (str) is shown
        below the controls.
    controls : dict of widgets by name.
    grid : dict by name of the values (list) of some controls, their own value among them.
    """
    start = {name: control.value for name, control in controls.items()}
    states = [draw(**start | dict(zip(grid, values, strict=True)))
              for values in product(*grid.values())]
    first = int(np.ravel_multi_index([list(values).index(start[name])
                                      for name, values in grid.items()],
                                     [len(values) for values in grid.values()]))
    still = draw(**start)
    _align(states)
    fields = "".join(_field(controls[name], values, start[name]) for name, values in grid.items())
    still.moving = _html(states, fields, first)
    for fig in states:
        plt.close(fig)
    return still


def _align(figures):
    """Give all figures the places of the first one's axes, and limits that contain theirs."""
    first = figures[0]
    for axes in zip(*(fig.axes for fig in figures), strict=True):
        plan = axes[0].get_aspect() == 1 and axes[0].get_adjustable() == "datalim"
        limits = np.array([[ax.get_xlim(), ax.get_ylim()] for ax in axes])
        low, high = limits[..., 0].min(axis=0), limits[..., 1].max(axis=0)
        for ax in axes:
            ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
            if plan:                                # equal by its limits, which `_widen` sets
                ax.set_aspect("auto")
        axes[0].widened = plan
    first.draw_without_rendering()                  # places the axes
    for ax in first.axes:
        if ax.widened:
            _widen(ax)
    for fig in figures:
        fig.set_layout_engine("none")
        for ax, model in zip(fig.axes, first.axes, strict=True):
            ax.set_position(model.get_position(original=True))
            ax.set(xlim=model.get_xlim(), ylim=model.get_ylim())


def _widen(ax):
    """Extend the limits of one axis until both have the same scale."""
    size = np.array([ax.bbox.width, ax.bbox.height])
    limits = np.array([ax.get_xlim(), ax.get_ylim()])
    span = size * (np.ptp(limits, axis=1) / size).max()
    middle = limits.mean(axis=1)
    (left, low), (right, high) = middle - span / 2, middle + span / 2
    ax.set(xlim=(left, right), ylim=(low, high))


def _field(control, values, start):
    """A slider, or a list for names, whose value is the index of one of `values` (HTML, str)."""
    label = escape(control.description)
    index = list(values).index(start)
    if isinstance(start, str):
        options = "".join(
            f'<option value="{i}"{" selected" * (i == index)}>{escape(value)}</option>'
            for i, value in enumerate(values))
        return (f'<label>{label}</label><select aria-label="{label}" data-count="{len(values)}">'
                f"{options}</select>")
    names = escape(json.dumps([f"{value:g}".replace("-", "−") for value in values],
                              ensure_ascii=False))
    return (f'<label>{label}</label><input type="range" aria-label="{label}" min="0" '
            f'max="{len(values) - 1}" value="{index}" data-count="{len(values)}" '
            f'data-names="{names}"><output>{start:g}</output>'.replace(">-", ">−"))


def _html(figures, fields, first):
    """HTML (str) of figures with the same axes, of which the one with index `first` is shown."""
    parts, definitions, states = {}, {}, []
    for fig in figures:
        panels, legend = _parts(fig, definitions)
        states.append([[parts.setdefault(part, len(parts)) for part in panel] for panel in panels])
    texts = list(parts)
    shown = "".join(
        f'<svg class="panel" viewBox="{box}" style="flex:{box.split()[2]} 1 0">'
        f'{"".join(texts[i] for i in panel)}</svg>'
        for box, panel in zip(_boxes(figures), states[first], strict=True))
    entries = "".join(f'<svg viewBox="{box}" style="width:{float(box.split()[2]) * 1.05:.0f}pt">'
                      '<use href="#legend"/></svg>' for box in _legend_boxes(figures[-1]))
    said = [re.sub(r"(?<=\d) (?=m\b|%)", "\u00a0", getattr(fig, "said", "")) for fig in figures]
    data = escape(json.dumps({"states": states, "said": said}, ensure_ascii=False,
                             separators=(",", ":")))
    html = (f'<svg width="0" height="0" style="position:absolute" aria-hidden="true"><defs>'
            f'{"".join(definitions.values())}<g id="legend">{"".join(legend)}</g></defs></svg>'
            f'<form hidden autocomplete="off">{fields}<input type="reset" value="Reset"></form>'
            f'<p class="says" role="status">'
            f'{escape(said[first])}</p><div class="panels">{shown}</div>'
            f'<div class="legend" aria-hidden="true">{entries}</div>'
            f'<div class="parts" hidden><svg>{"".join(texts)}</svg></div>')
    own = f"l{sha256(html.encode()).hexdigest()[:8]}-"
    html = re.sub(r'((?: id|href)="#?|url\(#)', rf"\1{own}", html)
    return f'<figure class="live" data-live="{data}">{html}</figure>'


def _parts(fig, definitions):
    """The SVG parts (lists of str) of each axes and of the legend; their definitions by id."""
    text = io.StringIO()
    with plt.rc_context({"path.simplify_threshold": CURVE_TOLERANCE}):
        FigureCanvasSVG(fig).print_svg(text, metadata={"Date": None})    # without a second layout
    root = ElementTree.fromstring(text.getvalue().encode())
    for parent in list(root.iter()):
        for child in [child for child in parent if child.tag == f"{SVG}defs"]:
            for definition in child:
                if name := definition.get("id"):
                    definitions.setdefault(name, _compact_element(definition))
            parent.remove(child)
    groups = {group.get("id"): group for group in root.iter(f"{SVG}g")}
    axes = [groups[f"axes_{number + 1}"] for number in range(len(fig.axes))]
    legend = [_compact_element(group) for name, group in groups.items()
              if name and name[:7] == "legend_" and not any(group in list(ax) for ax in axes)]
    return [[_compact_element(part) for part in group] for group in axes], legend


def _compact_element(element):
    """An element as compact SVG (str); only definitions keep their ids."""
    for part in element.iter():
        if LINK in part.attrib:
            part.set("href", part.attrib.pop(LINK))
        if part.tag == f"{SVG}g":
            part.attrib.pop("id", None)
    text = ElementTree.tostring(element, encoding="unicode")
    return shortened(re.sub(r'\sxmlns(:\w+)?="[^"]*"|(?<=[</])ns\d+:', "", text))


def _boxes(figures):
    """The viewBox (str) of each axes with all that belongs to it, all as high."""
    boxes = np.array([ax.get_tightbbox().extents for ax in figures[0].axes])
    for fig in figures:
        titles = [ax._left_title.get_window_extent() for ax in fig.axes]
        boxes[:, 2] = np.maximum(boxes[:, 2], [title.x1 for title in titles])
    boxes[:, 1], boxes[:, 3] = boxes[:, 1].min(), boxes[:, 3].max()
    return [_box(figures[0], corners[:2] - 4, corners[2:] + 4) for corners in boxes]


def _legend_boxes(fig):
    """The viewBox (str) of each entry of the figure's legend."""
    for legend in fig.legends:
        for text in legend.get_texts():
            handle = (legend.handlelength + legend.handletextpad) * text.get_fontsize()
            box = text.get_window_extent()
            reach = np.array([handle * fig.dpi / 72, 0])
            wider = [0.1 * box.width, 0]               # the reader's typeface may be wider
            yield _box(fig, [box.x0, box.y0] - reach - 3, np.add([box.x1, box.y1], wider) + 3)


def _box(fig, low, high):
    """The viewBox (str) in points between two corners in pixels, of which y runs upwards."""
    (x, y), (width, height) = low * 72 / fig.dpi, (high - low) * 72 / fig.dpi
    top = fig.get_figheight() * 72 - y - height
    return f"{x:.1f} {top:.1f} {width:.1f} {height:.1f}"
