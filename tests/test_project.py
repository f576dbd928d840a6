"""The project: imports run downwards, installations are complete, notebooks are stripped."""

import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions, requires
from pathlib import Path

import nbformat
import pytest
import yaml
from conftest import ROOT

from slamlib.report import notebooks

PACKAGE = ROOT / "slamlib"
MAKEFILE = (ROOT / "Makefile").read_text()

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def imported(folder=""):
    """Names of the modules from which those in a folder of slamlib import, in functions too."""
    statement = re.compile(r"^ *(?:from (?=\S+ import)|import (?!\S+ [^a]))([\w.]+)", re.MULTILINE)
    return {name for file in (PACKAGE / folder).rglob("*.py")
            for name in statement.findall(file.read_text())}


def outside(folder=""):
    """Names of the packages besides slamlib that a folder imports."""
    return {name.partition(".")[0] for name in imported(folder)} - {
        "slamlib", *sys.stdlib_module_names}


LOWER = {"core": set(), "robust": {"core"}, "io": {"core"},
         "studies": {"core", "robust", "io", ""},                # "" is slamlib itself
         "notebook": {"core", "robust", "io", "studies", "solve", ""},
         "report": {"core", "robust", "io", "studies", "notebook", "solve", ""}}


@pytest.mark.parametrize("folder", ["core", "robust"])
def test_numerics_use_numpy_scipy_and_gtsam_only(folder):
    assert outside(folder) <= {"numpy", "scipy", "gtsam"}


@pytest.mark.parametrize("folder", LOWER)
def test_arrows_run_downwards(folder):
    """Core imports nothing above it, robust and io import core, and so on; `solve` stands above."""
    names = {(name + ".").split(".")[1] for name in imported(folder) if name.startswith("slamlib")}
    assert names <= LOWER[folder] | {folder}


# Installations.


def required(lines):
    """Requirements as {name: the rest of its line}, of lines as `numpy` or `gtsam==4.3.0`."""
    found = (re.fullmatch(r"([\w-]+)(.*)", line) for line in lines)
    return {each[1].lower().replace("_", "-"): each[2].strip() for each in found}


def test_the_environment_of_conda_has_what_the_lock_is_made_from():
    """What pip installs there has the lock's versions."""
    *conda, by_pip = yaml.safe_load((ROOT / "environment.yml").read_text())["dependencies"]
    conda = required(conda)
    by_pip = required(by_pip["pip"])
    asked = required(line for line in (ROOT / "requirements.in").read_text().splitlines()
                     if not line.startswith("#"))
    assert conda.keys() | by_pip.keys() == asked.keys() | {"python", "pip"}
    assert {name: asked[name] for name in by_pip} == by_pip
    assert asked["gtsam"].startswith(f"=={conda['gtsam'].removesuffix('*')}")
    assert required(PROJECT["dependencies"]).keys() <= asked.keys()


def test_what_slamlib_imports_is_a_dependency_or_comes_with_one():
    asked = required(PROJECT["dependencies"])
    further = required(line for each in asked for line in requires(each) or ()
                       if "extra ==" not in line)
    for name in outside():
        package = packages_distributions()[name][0].lower().replace("_", "-")
        assert package in asked or package in further


def test_notebooks_are_those_of_the_folder_else_those_beside_the_sources(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert notebooks.notebooks_folder() == ROOT / "notebooks"
    (tmp_path / "notebooks").mkdir()
    assert notebooks.notebooks_folder() == Path("notebooks")


# Notebooks as JupyterLab saves them go back to the committed bytes.


def save_as_lab(file):
    """Save a notebook as JupyterLab does after a run: with outputs, counts and its metadata."""
    book = nbformat.read(file, as_version=4)
    for cell in book.cells:
        cell.metadata |= {"editable": True, "slideshow": {"slide_type": ""}, "trusted": True}
        if cell.cell_type == "code":
            cell.metadata |= {"execution": {}, "collapsed": True, "scrolled": True}
            cell.outputs = [nbformat.v4.new_output("stream", text="of JupyterLab: \u00e9")]
            cell.execution_count = 7
    book.metadata |= {"language_info": {"name": "python", "version": "3.99"}, "widgets": {}}
    nbformat.write(book, file)


def test_what_jupyterlab_saves_is_restored_to_the_byte_by_make_strip(tmp_path):
    options = re.search(r"^STRIP := ((?:.*\\\n)*.*)$", MAKEFILE, re.MULTILINE)[1]
    command = [sys.executable, *shlex.split(options.replace("\\\n", " "))]
    for source in (ROOT / "notebooks").glob("*.ipynb"):
        saved = Path(shutil.copy(source, tmp_path))
        save_as_lab(saved)
        subprocess.run([*command, saved], check=True, timeout=300)
        assert saved.read_bytes() == source.read_bytes()
