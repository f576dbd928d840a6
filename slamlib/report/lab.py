"""JupyterLab with the settings and the kept studies that the build's kernels have."""

import os
import sys

from slamlib.report.build import STUDIES
from slamlib.report.execution import kernel_environment

NO_NEWS = ("--LabApp.news_url=None",  # asks no question about news when it opens
           "--LabApp.check_for_updates_class=jupyterlab.NeverCheckForUpdate")


def start_lab(notebooks, data, kept, arguments):
    """Replace this process by JupyterLab.

    Parameters
    ----------
    notebooks, data, kept : Path, folders as of `build_report`.
    arguments : list of str, JupyterLab's.
    """
    os.execve(sys.executable, command(notebooks, arguments), environment(data, kept))


def command(notebooks, arguments):
    """Return the command (list of str) that opens JupyterLab on a folder, with its `arguments`.

    The administrator, as whom containers run, is let in: JupyterLab listens to this machine alone.
    """
    root = ["--allow-root"] if os.geteuid() == 0 else []
    return [sys.executable, "-m", "jupyter", "lab", *NO_NEWS, *root, *arguments, str(notebooks)]


def environment(data, kept):
    """Return the environment (dict of str) of JupyterLab, whose kernels inherit it.

    A cell computes there what it does in the build, with the studies that the build keeps. Its
    selection of datasets is that of SLAMLIB_DATASETS, if it is set.
    """
    settings = kept.resolve() / "settings"
    settings.mkdir(parents=True, exist_ok=True)
    chosen = os.environ.get("SLAMLIB_DATASETS")
    return kernel_environment(settings, data.resolve(), chosen and chosen.split("\n"),
                              kept / STUDIES)
