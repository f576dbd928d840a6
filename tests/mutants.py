"""Mutants: which small defects of the numerics does no test notice?

A mutant is slamlib with one change: an operator or comparison exchanged, a transpose, `wrap`, root,
sign or `not` dropped, two arguments exchanged, a number one more or less. For each of some mutants,
drawn at random, the tests that enter its function run until one fails; without one that fails, the
mutant survives. Every survivor is a missing test, dead code, or equivalent: no input tells it from
the original. `make mutants` runs this; `make mutants ARGS="--only robust --count 50"` a part of it.

Left out are the values of names in capital letters, since a threshold of 21 is as good as one of
20, and messages.
"""

import argparse
import ast
import os
import pickle
import random
import resource
import shutil
import sys
import tempfile
import time
from pathlib import Path

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "PYTEST_DISABLE_PLUGIN_AUTOLOAD"):
    os.environ[name] = "1"                                     # threads do not survive a fork
import gtsam  # noqa: E402, F401, I001  imported once, before every mutant's own process
import joblib  # noqa: E402, F401
import pytest  # noqa: E402
import scipy.io  # noqa: E402, F401
import scipy.sparse.linalg  # noqa: E402, F401
import scipy.stats  # noqa: E402, F401

ROOT = Path(__file__).parents[1]
FOLDERS = ("core", "robust", "io")
FILES = [f"test_{name}.py" for name in (
    "se2", "odometry", "results", "dataset", "dialects", "marker_increments", "localization",
    "jumps", "memory", "doubts", "calibration", "normal_equations", "graph", "slam", "uwb",
    "library", "numbers", "flaws", "overview")]
ENOUGH = 40                            # seconds, of the tests of one mutant
LIMITS = {resource.RLIMIT_AS: 8 << 30, resource.RLIMIT_CPU: 10 + 3 * ENOUGH}   # bytes, seconds
SWAPS = {ast.Add: ast.Sub, ast.Mult: ast.Div, ast.BitAnd: ast.BitOr, ast.And: ast.Or,
         ast.Lt: ast.Gt, ast.LtE: ast.GtE, ast.Eq: ast.NotEq, ast.Is: ast.IsNot, ast.In: ast.NotIn}
SWAPS |= {other: one for one, other in SWAPS.items()} | {ast.Pow: ast.Mult, ast.FloorDiv: ast.Mult}
DROPPED = {"wrap", "unwrap", "swapaxes", "transpose", "abs", "sqrt"}
SYMMETRIC = {"maximum", "minimum", "max", "min", "hypot", "union1d", "isclose", "allclose",
             "isinstance", "getattr", "array_equal", "squared_distances", "clip", "require"}
LAYOUT = {"reshape", "stack", "moveaxis", "axis", "assume_unique"}   # where -1 or False is as good


def name_of(node):
    """Name of what is called or given by keyword, or nothing."""
    function = getattr(node, "func", node)
    return getattr(function, "attr", getattr(function, "id", getattr(function, "arg", "")))


def changed(node, **fields):
    return type(node)(**vars(node) | fields)


def changes(node):
    """What may replace a node of the syntax tree: a list of nodes."""
    match node:
        case ast.BinOp(op=ast.MatMult()):
            return [changed(node, left=node.right, right=node.left)]
        case ast.BinOp(op=op) | ast.AugAssign(op=op) | ast.BoolOp(op=op) if type(op) in SWAPS:
            return [changed(node, op=SWAPS[type(op)]())]
        case ast.Compare(ops=[op, *rest]) if type(op) in SWAPS:
            return [changed(node, ops=[SWAPS[type(op)](), *rest])]
        case ast.UnaryOp(operand=inner) | ast.Attribute(attr="T" | "mT", value=inner):
            return [inner]
        case ast.Constant(value=bool(value)):
            return [ast.Constant(not value)]
        case ast.Constant(value=int(value) | float(value)):
            return [ast.Constant(value + 1), ast.Constant(value - 1)]
        case ast.Call(args=[inner, *_]) if name_of(node) in DROPPED:
            return [inner]
        case ast.Call(args=[ast.Name() as first, ast.Name() as second, *rest]):
            return [changed(node, args=[second, first, *rest])] * (name_of(node) not in SYMMETRIC)
    return []


def places(node, function=None):
    """(node, line of the function around it) for all nodes of a syntax tree that may be changed.

    The line is None outside of functions, and in those with decorators, which may be cached: then
    not all tests that need them enter them.
    """
    text = isinstance(node, ast.Raise | ast.JoinedStr) or {"'", '"'} & {*ast.unparse(node)}
    if isinstance(node, ast.FunctionDef):
        function = None if node.decorator_list else node.lineno
    elif isinstance(node, ast.expr | ast.AugAssign) and not text and changes(node):
        yield node, function
    for field, value in ast.iter_fields(node):
        for child in value if isinstance(value, list) else [value]:
            threshold = isinstance(node, ast.Module) and isinstance(child, ast.Assign)
            layout = name_of(node) in LAYOUT and not isinstance(child, ast.Name | ast.Call)
            if isinstance(child, ast.AST) and not threshold and not layout and field not in (
                    "annotation", "returns", "decorator_list", "format_spec", "exc"):
                yield from places(child, function)


def mutated(text, node, new):
    """A module's text with one node replaced."""
    lines = text.encode().splitlines(keepends=True)
    begin = len(b"".join(lines[:node.lineno - 1])) + node.col_offset
    end = len(b"".join(lines[:node.end_lineno - 1])) + node.end_col_offset
    whole = b"".join(lines)
    own = ast.unparse(new)
    own = own if isinstance(node, ast.stmt) else f"({own})"
    return (whole[:begin] + own.encode() + whole[end:]).decode()


class Watch:
    """A plugin of pytest: how long every test takes, and the functions that it enters.

    What a test's fixtures enter counts for all tests of its file, which may share them.
    """

    def __init__(self, package):
        self.package, self.tests, self.by_fixtures = package, [], {}

    def _traced(self, entered):
        """The set `entered`, to which all code is added that is entered from now on."""
        def trace(frame, *_):
            entered.add(frame.f_code)
        sys.settrace(trace)
        return entered

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup(self, item):
        """Watch the fixtures."""
        self._traced(self.by_fixtures.setdefault(item.path.name, set()))
        yield
        sys.settrace(None)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item):
        """Watch the test."""
        entered = self._traced(set())
        begin = time.process_time()
        yield
        sys.settrace(None)
        self.tests.append((time.process_time() - begin, item.path.name, item.nodeid, entered))

    def pytest_sessionfinish(self):
        """Keep (seconds, file, name, {(module, line) of functions}), the fastest test first."""
        self.tests.sort(key=lambda test: test[0])
        tests = [(seconds, file, name, {
            (code.co_filename.removeprefix(f"{self.package}/slamlib/"), code.co_firstlineno)
            for code in entered | self.by_fixtures[file]})
            for seconds, file, name, entered in self.tests]
        Path(self.package, "tests").write_bytes(pickle.dumps(tests))


class Only:
    """A plugin of pytest that runs the tests of these names, in their order."""

    def __init__(self, names):
        self.names = names

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items):
        """Choose them."""
        by_name = {item.nodeid: item for item in items}
        items[:] = [by_name[name] for name in self.names]


def passes(package, files, plugin, limits):
    """True if the tests in these files pass within limits, with the package in this folder.

    In a process of its own, which has no memory of other mutants.
    """
    pid = os.fork()
    if pid:
        return os.waitpid(pid, 0)[1] == 0
    silence = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silence, 1)
    os.dup2(silence, 2)
    for limit, value in limits.items():
        resource.setrlimit(limit, (value, value))              # which ends the process
    sys.path.insert(0, package)
    sys.dont_write_bytecode = True
    os.chdir(package)
    os._exit(pytest.main(
        ["-x", "-p", "no:cacheprovider", "-m", "not slow", "-c", str(ROOT / "pyproject.toml"),
         *(str(ROOT / "tests" / file) for file in files)], plugins=[plugin]))


def survives(package, tests):
    """True if no test notices the mutant in this folder; `tests` are those that enter its function.

    The fastest run, for ENOUGH seconds.
    """
    total, chosen = 0.0, {}
    for seconds, file, name, _ in tests:
        total += seconds
        if total < ENOUGH:
            chosen[name] = file
    return not chosen or passes(package, {*chosen.values()}, Only(chosen), LIMITS)


def main():
    """Print every survivor, and the share of the others."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=300, help="number of mutants (default 300)")
    parser.add_argument("--seed", type=int, default=0, help="of the draw (default 0)")
    parser.add_argument("--only", default="", help="modules whose name begins so: core, robust/fit")
    given = parser.parse_args()
    rng = random.Random(given.seed)
    modules = {str(path.relative_to(ROOT / "slamlib")): path.read_text(encoding="utf-8")
               for folder in FOLDERS for path in sorted((ROOT / "slamlib" / folder).glob("*.py"))}
    found = [(module, *place) for module, text in modules.items() if module.startswith(given.only)
             for place in places(ast.parse(text))]
    drawn = rng.sample(found, min(given.count, len(found)))
    print(f"{len(drawn)} mutants at {len(found)} places", flush=True)
    survivors = 0
    with tempfile.TemporaryDirectory() as package:
        shutil.copytree(ROOT / "slamlib", f"{package}/slamlib")
        if not passes(package, FILES, Watch(package), {}):
            sys.exit("A test fails without a mutant.")
        tests = pickle.loads(Path(package, "tests").read_bytes())
        for number, (module, node, function) in enumerate(drawn, 1):
            new = rng.choice(changes(node))
            file = Path(package, "slamlib", module)
            file.write_text(mutated(modules[module], node, new), encoding="utf-8")
            own = [test for test in tests if any(
                module == each and function in (line, None) for each, line in test[3])]
            if survives(package, own):
                survivors += 1
                print(f"{number:4} {module}:{node.lineno}: {ast.unparse(node)}   ->   "
                      f"{ast.unparse(new)}", flush=True)
            file.write_text(modules[module], encoding="utf-8")
    print(f"{1 - survivors / len(drawn):.0%} are noticed")


if __name__ == "__main__":
    main()
