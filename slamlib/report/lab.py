"""JupyterLab with the settings and the kept studies that the build's kernels have."""

import json
import os
import sys
from importlib.util import find_spec

from slamlib.dataset import DatasetError
from slamlib.report.build import STUDIES
from slamlib.report.execution import kernel_environment

SETTINGS = "settings"  # in the cache: of kernels, and JupyterLab's where the user has no others
OVERRIDES = {"@jupyterlab/apputils-extension:notification": {
    "fetchNews": "false", "checkForUpdates": False}}  # without a question when it opens


def start_lab(notebooks, data, kept, arguments):
    """Replace this process by JupyterLab with its `arguments`; folders as of `build_report`.

    Raises DatasetError if JupyterLab is not installed.
    """
    if find_spec("jupyterlab") is None:
        raise DatasetError(f"expected JupyterLab beside {sys.executable}, found none: install it, "
                           "as by pip install jupyterlab")
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
    """Return the environment (dict of str) of JupyterLab and its kernels, that of a build."""
    selected = os.environ.get("SLAMLIB_DATASETS", "").split("\n")
    return kernel_environment(settings, data.resolve(), selected, kept / STUDIES)
