"""Examples run: those of docstrings, docs/code.md and the README."""

import doctest
import re
import textwrap
from importlib import import_module
from pkgutil import walk_packages

import numpy as np
import pytest
from conftest import ROOT

import slamlib

MODULES = [module.name for module in walk_packages(slamlib.__path__, "slamlib.")]


@pytest.mark.parametrize("module", MODULES)
def test_examples_in_docstrings_are_true(module, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)                                         # some write files
    assert doctest.testmod(import_module(module)).failed == 0


@pytest.mark.slow
def test_examples_in_the_map_of_the_code_are_true(monkeypatch):
    monkeypatch.chdir(ROOT)
    failed, tried = doctest.testfile(str(ROOT / "docs" / "code.md"), module_relative=False)
    assert failed == 0 < tried


def test_the_example_of_the_readme_runs(tmp_path, monkeypatch):
    """On data/short, in the folder of the README; what it writes is what it says."""
    section = (ROOT / "README.md").read_text().split("## As a library\n")[1]
    examples = re.findall(r"(?:^    .*\n|^\n(?=    ))+", section, re.MULTILINE)
    (tmp_path / "data").symlink_to(ROOT / "data")
    monkeypatch.chdir(tmp_path)
    names = {}
    for example in examples[:3]:
        exec(textwrap.dedent(example), names)  # noqa: S102
    assert names["plain"].converged
    np.testing.assert_array_equal(names["found"].poses, names["same"].poses)
    rows = np.loadtxt(tmp_path / "build" / "short.tum")
    np.testing.assert_array_equal(rows[:, 1:3], names["found"].poses[:, :2])
    assert (tmp_path / "build" / "short.svg").exists()
