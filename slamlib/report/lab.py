"""JupyterLab with the settings and the kept studies that the build's kernels have."""

import json
import os
import sys

from slamlib.report.build import STUDIES
from slamlib.report.execution import kernel_environment

SETTINGS = "settings"  # in the cache: of kernels, and JupyterLab's where the user has no others
OVERRIDES = {"@jupyterlab/apputils-extension:notification": {
    "fetchNews": "false", "checkForUpdates": False}}  # without a question when it opens


def start_lab(notebooks, data, kept, arguments):
    """Replace this process by JupyterLab.

    Parameters
    ----------
    notebooks, data, kept : Path, folders as of `build_report`.
    arguments : list of str, JupyterLab's.
    """
    settings = kept.resolve() / SETTINGS
    settings.mkdir(parents=True, exist_ok=True)
    (settings / "overrides.json").write_text(json.dumps(OVERRIDES))
    options = [f"--LabApp.app_settings_dir={settings}",
               "--LabApp.check_for_updates_class=jupyterlab.NeverCheckForUpdate"]
    # As in containers; JupyterLab listens to this machine alone. Windows has no such numbers.
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        options.append("--allow-root")
    os.execve(sys.executable,
              [sys.executable, "-m", "jupyterlab", *options, *arguments, str(notebooks)],
              environment(settings, data, kept))


def environment(settings, data, kept):
    """Return the environment (dict of str) of JupyterLab, whose kernels inherit it.

    A cell computes there what it does in the build, with the studies that the build keeps. Its
    selection of datasets is that of SLAMLIB_DATASETS, if it is set.
    """
    selected = os.environ.get("SLAMLIB_DATASETS", "").split("\n")
    return kernel_environment(settings, data.resolve(), selected, kept / STUDIES)
