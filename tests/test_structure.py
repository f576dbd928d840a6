"""The structure of the package: imports run downwards, modules and functions are short."""

import ast
import sys
from pathlib import Path

import pytest

import slamlib

ROOT = Path(slamlib.__file__).parent
NUMERICS = ("localization", "slam")          # and the modules of slamlib itself
FILES = sorted(ROOT.rglob("*.py"))
MAX_MODULE, MAX_BODY = 300, 40               # lines; of a function without its docstring


def name_of(file):
    parts = ("slamlib", *file.relative_to(ROOT).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {name_of(file): ast.parse(file.read_text(encoding="utf-8")) for file in FILES}


def imports(module, everywhere=True):
    """Names of slamlib's modules that a module imports, in functions too or at its top only."""
    found = set()
    for node in ast.walk(MODULES[module]) if everywhere else MODULES[module].body:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{module}: expected absolute imports"
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                found.add(inner if inner in MODULES else node.module)
    return {name for name in found if name in MODULES}


def package(module):
    """The sub-package of a module, "" for the modules of slamlib itself."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 and (ROOT / parts[1]).is_dir() else ""


def outside(module):
    """Names of the packages besides slamlib that a module imports, and "importlib"."""
    names = {name for node in ast.walk(MODULES[module]) if isinstance(node, ast.Import)
             for name in (alias.name for alias in node.names)}
    names |= {node.module for node in ast.walk(MODULES[module]) if isinstance(node, ast.ImportFrom)}
    names = {name.partition(".")[0] for name in names}
    return {name for name in names if name not in sys.stdlib_module_names - {"importlib"}
            and name != "slamlib"}


@pytest.mark.parametrize("module", [name for name in MODULES if package(name) in NUMERICS])
def test_numerics_use_numpy_scipy_and_gtsam_only(module):
    """And of slamlib's own modules none that judges, writes or simulates."""
    assert outside(module) <= {"numpy", "scipy", "gtsam"}
    assert not imports(module) & {f"slamlib.{name}" for name in (
        "evaluation", "results", "export", "solve", "summary", "simulation", "swap", "locks",
        "arguments", "inventory")}


def test_what_reads_a_dataset_judges_nothing():
    assert "slamlib.evaluation" not in imports("slamlib.dataset") | imports("slamlib.sightings")


def test_the_walk_sees_what_is_imported():
    assert outside("slamlib.studies.memory") >= {"joblib", "numpy", "tqdm"}
    assert "slamlib.slam.factors" in imports("slamlib.slam.fit")
    assert "slamlib.summary" in imports("slamlib.__main__")
    assert "slamlib.se2" in imports("slamlib.evaluation")


@pytest.mark.parametrize("module", MODULES)
def test_arrows_run_downwards(module):
    """Numerics import no studies, notebooks or pages; studies import no notebooks or pages."""
    allowed = {
        "": {""}, "localization": {"", "localization"}, "slam": {"", "slam"},
        "checks": {"", *NUMERICS, "checks"},
        "studies": {"", *NUMERICS, "studies"}, "notebook": {"", *NUMERICS, "studies", "notebook"},
        "report": {"", *NUMERICS, "checks", "studies", "notebook", "report"}}[package(module)]
    allowed = {"slamlib.solve": {"", *NUMERICS, "checks"},
               "slamlib.summary": {"", *NUMERICS, "checks"}}.get(module, allowed)
    if module != "slamlib.__main__":
        assert {package(name) for name in imports(module)} <= allowed
    own = module.rpartition(".")[0]
    assert own == "slamlib" or own not in imports(module), f"{module} imports its own package"


def test_no_module_imports_itself_by_way_of_others():
    """A package's __init__ only gathers names: its own modules do not count as importing it."""
    arrows = {module: {name for name in imports(module)
                       if not module.startswith(f"{name}.")} for module in MODULES}
    finished, path = set(), []

    def visit(module):
        assert module not in path, " -> ".join([*path[path.index(module):], module])
        if module not in finished:
            path.append(module)
            for name in arrows[module]:
                visit(name)
            finished.add(path.pop())

    for module in MODULES:
        visit(module)


@pytest.mark.parametrize("file", FILES, ids=name_of)
def test_modules_and_functions_are_short(file):
    text = file.read_text(encoding="utf-8")
    assert text.count("\n") <= MAX_MODULE
    for node in ast.walk(MODULES[name_of(file)]):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            first = node.body[1] if ast.get_docstring(node) and len(node.body) > 1 else node.body[0]
            assert node.end_lineno - first.lineno + 1 <= MAX_BODY, node.name
