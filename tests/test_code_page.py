"""docs/code.md lists every module of slamlib, and nothing else; what it names is there."""

import re
from importlib import import_module
from pathlib import Path

import slamlib

ROOT = Path(slamlib.__file__).parent


def test_the_table_of_modules_is_complete():
    text = (ROOT.parent / "docs" / "code.md").read_text(encoding="utf-8")
    rows = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    listed = sorted(name for row in rows for name in re.findall(r"`([\w/]+\.py)`", row))
    modules = [file.relative_to(ROOT).as_posix() for file in ROOT.rglob("*.py")]
    assert listed == sorted(name for name in modules if not name.endswith("__init__.py"))


def test_the_table_of_packages_is_complete():
    text = (ROOT.parent / "docs" / "code.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"^\| `slamlib/(\w+)/` \|", text, re.MULTILINE))
    assert listed == {file.parent.name for file in ROOT.glob("*/__init__.py")}


def test_functions_that_it_names_exist():
    text = (ROOT.parent / "docs" / "code.md").read_text(encoding="utf-8")
    text = text.split("## Where to look")[1].split("## All modules")[0]
    names = [name for name in re.findall(r"`([\w.]+)`", text)
             if name.count(".") and not name.endswith((".txt", ".mat")) and name != "module.function"]
    assert len(names) > 20
    for name in names:
        module, _, function = name.rpartition(".")
        assert callable(getattr(import_module(f"slamlib.{module}"), function)), name
