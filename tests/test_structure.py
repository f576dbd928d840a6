"""The structure of the package: imports run downwards, modules and functions are short."""

import ast
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import slamlib

ROOT = Path(slamlib.__file__).parent
NUMERICS = ("localization", "slam")          # and the modules of slamlib itself
FILES = sorted(ROOT.rglob("*.py"))
MAX_MODULE, MAX_BODY = 330, 40               # lines; of a function without its docstring


def name_of(file):
    parts = ("slamlib", *file.relative_to(ROOT).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {name_of(file): ast.parse(file.read_text(encoding="utf-8")) for file in FILES}


def imported(module):
    """Full names of what a module imports, in functions too, beside the modules that hold them."""
    for node in ast.walk(MODULES[module]):
        if isinstance(node, ast.Import):
            yield from ((alias.name, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{module}: expected absolute imports"
            yield from ((f"{node.module}.{alias.name}", node.module) for alias in node.names)


def imports(module):
    """Names of slamlib's modules that a module imports."""
    return {name if name in MODULES else owner for name, owner in imported(module)} & {*MODULES}


def package(module):
    """The sub-package of a module, "" for the modules of slamlib itself."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 and (ROOT / parts[1]).is_dir() else ""


def outside(module):
    """Names of the packages besides slamlib that a module imports, and "importlib"."""
    names = {owner.partition(".")[0] for _, owner in imported(module)}
    return names - (sys.stdlib_module_names - {"importlib"}) - {"slamlib"}


def test_numerics_use_numpy_scipy_and_gtsam_only():
    """And of slamlib's own modules none that judges, writes or simulates."""
    others = {f"slamlib.{name}" for name in (
        "evaluation", "results", "solve", "simulation", "swap")}
    for module in MODULES:
        if package(module) in NUMERICS:
            assert outside(module) <= {"numpy", "scipy", "gtsam"}, module
            assert not imports(module) & others, module
    assert "slamlib.evaluation" not in imports("slamlib.dataset") | imports("slamlib.sightings")


def test_arrows_run_downwards():
    """Numerics import no studies, notebooks or pages; studies import no notebooks or pages."""
    lower = {"": {""}, "localization": {""}, "slam": {""}, "checks": {"", *NUMERICS},
             "studies": {"", *NUMERICS}, "notebook": {"", *NUMERICS, "studies"},
             "report": {"", *NUMERICS, "checks", "studies", "notebook"}}
    above = {"slamlib.solve": {*NUMERICS, "checks"}}
    for module in MODULES:
        of, own = package(module), module.rpartition(".")[0]
        if module != "slamlib.__main__":
            assert {package(name) for name in imports(module)} <= {
                of, *lower[of], *above.get(module, ())}, module
        assert own == "slamlib" or own not in imports(module), f"{module} imports its own package"


def test_no_module_imports_itself_by_way_of_others():
    """A package's __init__ only gathers names: its own modules do not count as importing it."""
    TopologicalSorter({module: {name for name in imports(module)
                                if not module.startswith(f"{name}.")}
                       for module in MODULES}).prepare()


def test_dataclasses_are_frozen():
    made = [(module, ast.unparse(decorator)) for module, tree in MODULES.items()
            for node in ast.walk(tree) if isinstance(node, ast.ClassDef)
            for decorator in node.decorator_list if "dataclass" in ast.unparse(decorator)]
    assert len(made) > 20 and all("frozen=True" in decorator for _, decorator in made)


def test_modules_and_functions_are_short():
    for file in FILES:
        assert file.read_text(encoding="utf-8").count("\n") <= MAX_MODULE, file
        for node in ast.walk(MODULES[name_of(file)]):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                first = node.body[bool(ast.get_docstring(node) and len(node.body) > 1)]
                assert node.end_lineno - first.lineno + 1 <= MAX_BODY, (file, node.name)
