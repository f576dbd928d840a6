"""The project: imports run downwards, installations are complete, notebooks are stripped."""

import ast
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions, requires
from pathlib import Path

import nbformat
import yaml
from conftest import ROOT

from slamlib.report import notebooks

PACKAGE = ROOT / "slamlib"
MAKEFILE = (ROOT / "Makefile").read_text()

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
FILES = sorted(PACKAGE.rglob("*.py"))


def name_of(file):
    parts = ("slamlib", *file.relative_to(PACKAGE).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {name_of(file): ast.parse(file.read_text(encoding="utf-8")) for file in FILES}


def imported(module):
    """Full names of what a module imports, in functions too, beside the modules that hold them."""
    for node in ast.walk(MODULES[module]):
        if isinstance(node, ast.Import):
            yield from ((alias.name, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from ((f"{node.module}.{alias.name}", node.module) for alias in node.names)


def imports(module):
    """Names of slamlib's modules that a module imports."""
    return {name if name in MODULES else owner for name, owner in imported(module)} & {*MODULES}


def package(module):
    """The sub-package of a module, "" for the modules of slamlib itself."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 and (PACKAGE / parts[1]).is_dir() else ""


def outside(module):
    """Names of the packages besides slamlib that a module imports, and "importlib"."""
    names = {owner.partition(".")[0] for _, owner in imported(module)}
    return names - (sys.stdlib_module_names - {"importlib"}) - {"slamlib"}


LOWER = {"core": set(), "robust": {"core"}, "io": {"core"},
         "studies": {"core", "robust", "io"}, "notebook": {"core", "robust", "io", "studies"},
         "report": {"core", "robust", "io", "studies", "notebook"}}
NUMERICS = {"core", "robust"}


def test_numerics_use_numpy_scipy_and_gtsam_only():
    for module in MODULES:
        if package(module) in NUMERICS:
            assert outside(module) <= {"numpy", "scipy", "gtsam"}, module


def test_arrows_run_downwards():
    """Core imports nothing above it, robust and io import core, and so on; `solve` stands above."""
    for module in MODULES:
        of = package(module)
        names = imports(module)
        assert f"slamlib.{of}" not in names, f"{module} imports its own package"
        if of in NUMERICS:
            assert "slamlib" not in names, module
        if of:
            allowed = LOWER[of] | {of, ""}                       # `slamlib` itself, and `solve`
            assert {package(name) for name in names} <= allowed, module
            assert "slamlib.solve" not in names or of in ("notebook", "report"), module


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
    for module in MODULES:
        for name in outside(module) - {"importlib"}:
            package = packages_distributions()[name][0].lower().replace("_", "-")
            assert package in asked or package in further, module


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
            cell.metadata |= {"execution": {"iopub.execute_input": "2026-01-01T00:00:00.0Z"},
                              "collapsed": True, "scrolled": True}
            cell.outputs = [nbformat.v4.new_output("stream", text="of JupyterLab: \u00e9")]
            cell.execution_count = 7
    book.metadata |= {
        "language_info": {"name": "python", "version": "3.99", "pygments_lexer": "ipython3"},
        "widgets": {"application/vnd.jupyter.widget-state+json": {"state": {}}}}
    nbformat.write(book, file)


def test_what_jupyterlab_saves_is_restored_to_the_byte_by_make_strip(tmp_path):
    options = re.search(r"^STRIP := ((?:.*\\\n)*.*)$", MAKEFILE, re.MULTILINE)[1]
    command = [sys.executable, *shlex.split(options.replace("\\\n", " "))]
    for source in (ROOT / "notebooks").glob("*.ipynb"):
        saved = Path(shutil.copy(source, tmp_path))
        save_as_lab(saved)
        subprocess.run([*command, saved], check=True, timeout=300)
        assert saved.read_bytes() == source.read_bytes()
