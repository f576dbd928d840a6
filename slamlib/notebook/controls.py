"""Shows figures with controls: widgets in JupyterLab, and fields in the report's HTML pages.

While the kernel draws for a widget, the browser keeps only the latest value of it. The kernel may
serve several widgets in threads; a lock lets one of them draw at a time.
"""

from html import escape
from threading import RLock
from time import perf_counter

import matplotlib.pyplot as plt
from IPython.display import clear_output, display
from ipywidgets import HTML, Box, Button, Dropdown, FloatSlider, IntSlider, Layout, Output, VBox

from slamlib.notebook.live import live_figure
from slamlib.notebook.show import Drive, interactive
from slamlib.solve import UNSOLVABLE

MAX_LIVE_DRAWING = 0.3       # s, drawing time of a figure that follows a dragged slider
SIMULATED = Drive("simulated", None, None, made_up=True)
CONTROLS_LAYOUT = Layout(display="flex", flex_flow="row wrap")
SENTENCE_LAYOUT = Layout(min_height="3.2em", max_width="62em")   # always two lines high


def slider(label, start, low, high, step=1):
    """A slider from `low` to `high`, of integers if all arguments are integers, else of floats."""
    whole = all(isinstance(number, int) for number in (start, low, high, step))
    return (IntSlider if whole else FloatSlider)(start, min=low, max=high, step=step,
                                                 description=label)


def choice(label, options, start):
    """A drop-down list of names (str), of which `start` is chosen first."""
    return Dropdown(options=list(options), value=start, description=label)


def drive_choice(drives):
    """A drop-down list of SIMULATED, which is chosen first, and these recorded Drives."""
    return Dropdown(description="drive", options=[
        (drive.name, drive) for drive in (SIMULATED, *drives) if drive is SIMULATED
        or not drive.made_up])


def show_with_controls(draw, grid=None, only_simulated=(), **controls):
    """Show the figure of draw(**values), in JupyterLab with controls of the values.

    Parameters
    ----------
    draw : function of the controls' values, by name, that returns a figure. Its attribute `said`
        (str) is shown between the controls and the figure.
    grid : dict by name of the values (list) that some controls have in the report's HTML page.
    only_simulated : names of the controls that change nothing unless the control `drive`, which is
        by `drive_choice`, is SIMULATED.
    controls : widgets with a value, as of `slider` and `choice`.
    """
    if interactive():
        display(panel(draw, controls, only_simulated))
    else:
        live_figure(draw, controls, grid or {})


def panel(draw, controls, only_simulated=()):
    """A widget of controls, a button Reset, the sentence and the figure, for `show_with_controls`.

    A slider redraws the figure while it is dragged if the last drawing that it or a list caused
    took less than MAX_LIVE_DRAWING, else when it is released. The first drawing, which also loads
    typefaces, and those of Reset, which may be cached, do not count. Reset replaces the widgets, so
    that the browser drops the values of the old ones that it has not sent.
    """
    row = Box(layout=CONTROLS_LAYOUT)
    reset = Button(description="Reset", tooltip="Return to the first values")
    said, picture = HTML(layout=SENTENCE_LAYOUT), Output()
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
                fast = perf_counter() - begin < MAX_LIVE_DRAWING
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
    """Show the figure of draw(**values) in an Output; its or the error's sentence as HTML (str)."""
    with picture:                                # which also shows other exceptions
        try:
            fig = draw(**values)
        except UNSOLVABLE as error:
            clear_output()
            return escape(f"There is no solution with these values: {error}.")
        clear_output(wait=True)
        display(fig)
        plt.close(fig)
        return escape(getattr(fig, "said", ""))
    return ""


def _copy(control, value):
    """A new widget like a slider or list, with a value."""
    traits = ("min", "max", "step", "options", "description")
    new = type(control)(value=value, **{name: getattr(control, name) for name in traits
                                        if control.has_trait(name)})
    new.style.description_width, new.layout.width = "12em", "31em"
    return new
