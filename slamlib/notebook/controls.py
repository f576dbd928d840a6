"""Controls of the Explore sections: widgets in JupyterLab, and fields of the report's HTML pages.

In JupyterLab every change draws the figure once, before the kernel takes the next message. The
browser holds a slider's values back until then and sends only the latest, so old ones never wait.
"""

from html import escape
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
    and those of Reset, which may be remembered, do not count.
    """
    first = {name: control.value for name, control in controls.items()}
    sliders = [control for control in controls.values() if hasattr(control, "continuous_update")]
    reset = Button(description="Reset", tooltip="All controls as they were at first")
    said, picture = HTML(layout=SENTENCE), Output()

    def redraw(change):
        begin = perf_counter()
        for name in only_simulated:
            controls[name].disabled = controls["drive"].value is not SIMULATED
        with picture:
            try:
                fig = draw(**{name: control.value for name, control in controls.items()})
            except UNSOLVABLE as error:
                clear_output()
                said.value = escape(f"There is no solution with these values: {error}.")
            else:
                said.value = escape(getattr(fig, "said", ""))
                clear_output(wait=True)
                display(fig)
                plt.close(fig)
        if change is not None:
            fast = perf_counter() - begin < FAST
            for each in [change.owner] if change.owner in sliders else sliders:
                each.continuous_update = fast

    def restart(_):
        for name, control in controls.items():
            control.unobserve(redraw, "value")
            control.value = first[name]
            control.observe(redraw, "value")
        redraw(None)

    for control in controls.values():
        control.style.description_width = "12em"
        control.layout.width = "31em"
        control.observe(redraw, "value")
    reset.on_click(restart)
    redraw(None)
    return VBox([Box([*controls.values(), reset], layout=ROW), said, picture])
