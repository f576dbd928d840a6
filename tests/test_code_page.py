"""docs/code.md lists every module of slamlib, and nothing else; what it names is there."""

import re
from importlib import import_module
from pathlib import Path

import slamlib

ROOT = Path(slamlib.__file__).parent
TEXT = (ROOT.parent / "docs" / "code.md").read_text(encoding="utf-8")


def test_the_tables_of_modules_and_packages_are_complete():
    rows = [line.split("|")[1] for line in TEXT.splitlines() if line.startswith("| `")]
    modules = [file.relative_to(ROOT).as_posix() for file in ROOT.rglob("*.py")]
    assert sorted(name for row in rows for name in re.findall(r"`([\w/]+\.py)`", row)) == sorted(
        name for name in modules if not name.endswith("__init__.py"))
    assert set(re.findall(r"^\| `slamlib/(\w+)/` \|", TEXT, re.MULTILINE)) == {
        file.parent.name for file in ROOT.glob("*/__init__.py")}


def test_functions_that_it_names_exist():
    text = TEXT.split("## Where to look")[1].split("## Factors of your own")[0]
    names = set(re.findall(r"`(\w[\w.]*\.\w+)`", text)) - {
        "module.function", "UwbReading.txt", "UwbMap.mat"}
    assert len(names) > 20
    for name in names:
        module, _, function = name.rpartition(".")
        assert callable(getattr(import_module(f"slamlib.{module}"), function)), name
