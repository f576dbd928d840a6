"""Controls of the Explore sections: widgets in JupyterLab, and fields of the report's HTML pages.

In JupyterLab the browser holds a widget's values back while the kernel draws for one of them, and
then sends the latest only, so old ones never wait. The kernel may serve several widgets at once, in
threads of their own; a lock lets one of them draw at a time.
"""

from html import escape
from threading import RLock
from time import perf_counter

import matplotlib.pyplot as plt
from IPython.display import clear_output, display
from ipywidgets import HTML, Box, Button, Dropdown, FloatSlider, IntSlider, Layout, Output, VBox

from slamlib.notebook.live import live
from slamlib.notebook.show import Drive, interactive
from slamlib.solve import UNSOLVABLE

FAST = 0.3                   # s, time of drawing below which a figure follows a dragged slider
SIMULATED = Drive("simulated", None, None, made_up=True)
ROW = Layout(display="flex", flex_flow="row wrap")
SENTENCE = Layout(min_height="3.2em", max_width="62em")       # two lines, so that nothing jumps


def slider(label, start, low, high, step=1):
    """A slider from `low` to `high`, of integers if all its numbers are, else of floats."""
    whole = all(isinstance(number, int) for number in (start, low, high, step))
    return (IntSlider if whole else FloatSlider)(start, min=low, max=high, step=step,
                                                 description=label)


def choice(label, options, start):
    """A drop-down list of names; its value is the name chosen, `start` at first."""
    return Dropdown(options=list(options), value=start, description=label)


def drive_choice(drives):
    """A drop-down list whose value is one of these Drives, or SIMULATED, which it is at first."""
    return Dropdown(description="drive", options=[
        (drive.name, drive) for drive in (SIMULATED, *drives) if drive is SIMULATED
        or not drive.made_up])


def show(draw, grid=None, only_simulated=(), **controls):
    """Show the figure of draw(**values), in JupyterLab with controls of the values.

    Parameters
    ----------
    draw : function of the controls' values, by name, that makes one figure. What its attribute
        `said` (str) says stands between the controls and the figure.
    grid : dict by name of the values (list) that some controls have in the report's HTML page.
    only_simulated : names of the controls that change nothing unless the control `drive`, which is
        by `drive_choice`, is SIMULATED.
    controls : widgets with a value, as of `slider` and `choice`.
    """
    if interactive():
        display(panel(draw, controls, only_simulated))
    else:
        live(draw, controls, grid or {})


def panel(draw, controls, only_simulated=()):
    """A widget: the controls and a button Reset, the sentence and the figure; as of `show`.

    A slider redraws the figure while it is dragged if the last drawing that it or a list caused
    took less than FAST; else when it is released. The first drawing, which also loads typefaces,
    and those of Reset, which may be remembered, do not count. Reset replaces the widgets: values of
    the old ones that the browser still holds back are lost with these.
    """
    row, reset = Box(layout=ROW), Button(description="Reset", tooltip="Return to the first values")
    said, picture = HTML(layout=SENTENCE), Output()
    first, shown = {name: control.value for name, control in controls.items()}, {}
    lock, drawn = RLock(), {}

    def redraw(change):
        with lock:
            values = {name: control.value for name, control in shown.items()}
            if values == drawn:                  # by another widget's drawing, meanwhile
                return
            drawn.update(values)
            begin = perf_counter()
            for name in only_simulated:
                shown[name].disabled = values["drive"] is not SIMULATED
            said.value = _drawn(draw, values, picture)
            if change is not None:
                fast = perf_counter() - begin < FAST
                sliders = [each for each in shown.values() if each.has_trait("continuous_update")]
                for each in [change.owner] if change.owner in sliders else sliders:
                    each.continuous_update = fast

    def restart(_):
        with lock:
            for name, control in list(shown.items()) or controls.items():
                shown[name] = _copy(control, first[name])
                shown[name].observe(redraw, "value")
                control.close()                  # with values that the browser has not sent yet
            row.children = list(shown.values())
            redraw(None)

    restart(None)
    reset.on_click(restart)
    return VBox([row, reset, said, picture])


def _drawn(draw, values, picture):
    """What the figure of draw(**values), shown in an Output, says as HTML; or why there is none."""
    said = ""
    with picture:                                # which also shows other exceptions
        try:
            fig = draw(**values)
        except UNSOLVABLE as error:
            clear_output()
            said = escape(f"There is no solution with these values: {error}.")
        else:
            clear_output(wait=True)
            display(fig)
            plt.close(fig)
            said = escape(getattr(fig, "said", ""))
    return said


def _copy(control, value):
    """A new widget like a slider or list, with a value."""
    traits = ("min", "max", "step", "options", "description")
    new = type(control)(value=value, **{name: getattr(control, name) for name in traits
                                        if control.has_trait(name)})
    new.style.description_width, new.layout.width = "12em", "31em"
    return new
