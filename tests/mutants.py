"""Mutants: which small defects of the numerics does no test notice?

A mutant is slamlib with one change: an operator or comparison exchanged, a transpose, `wrap`, root,
sign or `not` dropped, two arguments exchanged, a number one more or less. For each of some mutants,
drawn at random, the tests that enter its function run until one fails; without one that fails, the
mutant survives. Every survivor is a missing test, dead code, or equivalent: no input tells it from
the original. `make mutants` runs this; `make mutants ARGS="--only robust --count 50"` a part of it.

Numbers that a module names in capital letters are left out: a threshold of 21 is as good as one of
20. What mutants say in messages is left out, too.
"""

import argparse
import ast
import compileall
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
FOLDERS = ("core/", "robust/", "io/")
FILES = [f"test_{name}.py" for name in (
    "se2", "odometry", "results", "dataset", "dialects", "marker_increments", "localization",
    "jumps", "memory", "doubts", "calibration", "normal_equations", "graph", "slam", "uwb",
    "library", "numbers", "flaws", "overview")]
ENOUGH = 40                            # seconds, of the tests of one mutant
MEMORY = 8 << 30                       # bytes, of a mutant's process
PATIENCE = 3                           # times as long as without a mutant, and START seconds
START = 10
SWAPS = {ast.Add: ast.Sub, ast.Mult: ast.Div, ast.BitAnd: ast.BitOr, ast.And: ast.Or,
         ast.Lt: ast.Gt, ast.LtE: ast.GtE, ast.Eq: ast.NotEq, ast.Is: ast.IsNot, ast.In: ast.NotIn}
SWAPS |= {other: one for one, other in SWAPS.items()} | {ast.Pow: ast.Mult, ast.FloorDiv: ast.Mult}
DROPPED = {"wrap", "unwrap", "swapaxes", "transpose", "abs", "sqrt"}
SYMMETRIC = {"maximum", "minimum", "max", "min", "hypot", "union1d", "isclose", "allclose",
             "isinstance", "getattr", "array_equal", "squared_distances", "clip"}
AXES = {"reshape", "stack", "moveaxis", "axis", "assume_unique"}    # where -1 or False is as good
FIRST_ONLY = {"require", "_number"}


def is_text(node):
    """True of an expression with text, for which operators mean something else."""
    return bool({"'", '"'} & {*ast.unparse(node)})


def is_message(node):
    """True of an expression of text: it may be left out, but nothing in it is changed."""
    return isinstance(node, ast.Raise | ast.JoinedStr) or isinstance(node, ast.Call) and isinstance(
        node.func, ast.Attribute) and isinstance(node.func.value, ast.Constant)


def name_of(function):
    """Name of a function in a call, or nothing."""
    return getattr(function, "attr", getattr(function, "id", ""))


def changed(node, **fields):
    return type(node)(**vars(node) | fields)


def changes(node):
    """What may replace a node of the syntax tree: a list of nodes."""
    found = []
    if isinstance(node, (ast.BinOp, ast.AugAssign)) and not is_text(node):
        if type(node.op) in SWAPS:
            found.append(changed(node, op=SWAPS[type(node.op)]()))
        elif isinstance(node.op, ast.MatMult) and isinstance(node, ast.BinOp):
            found.append(changed(node, left=node.right, right=node.left))
    elif isinstance(node, ast.BoolOp) and not any(
            is_text(each) for each in node.values if not isinstance(each, ast.Compare)):
        found.append(changed(node, op=SWAPS[type(node.op)]()))
    elif isinstance(node, ast.Compare) and type(node.ops[0]) in SWAPS:
        found.append(changed(node, ops=[SWAPS[type(node.ops[0])](), *node.ops[1:]]))
    elif isinstance(node, ast.UnaryOp):
        found.append(node.operand)
    elif isinstance(node, ast.Attribute) and node.attr == "T":
        found.append(node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        found.append(ast.Constant(not node.value))
    elif isinstance(node, ast.Constant) and isinstance(node.value, (int, float)):
        found += [ast.Constant(node.value + 1), ast.Constant(node.value - 1)]
    elif isinstance(node, ast.Return) and isinstance(node.value, ast.BinOp) and not is_text(node):
        found.append(changed(node, value=ast.UnaryOp(ast.USub(), node.value)))
    elif isinstance(node, ast.Call):
        name = name_of(node.func)
        if name in DROPPED and node.args:
            found.append(node.args[0])
        elif name not in SYMMETRIC and len(node.args) > 1 and not any(
                isinstance(each, (ast.Constant, ast.UnaryOp, ast.List, ast.Tuple, ast.Starred))
                or is_text(each) for each in node.args[:2]):
            found.append(changed(node, args=[*node.args[1::-1], *node.args[2:]]))
    return [new for new in found if ast.unparse(new) != ast.unparse(node)]


def places(node):
    """Nodes of a syntax tree that may be changed, without annotations, decorators and messages.

    Arguments of FIRST_ONLY but the first are a message or limits.
    """
    if is_message(node):
        return
    if changes(node):
        yield node
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list", "format_spec"):
            continue
        name = name_of(node.func) if isinstance(node, ast.Call) else getattr(node, "arg", "")
        children = value if isinstance(value, list) else [value]
        for child in children[:1] if name in FIRST_ONLY else children:
            threshold = isinstance(node, ast.Module) and isinstance(child, ast.Assign)
            axis = name in AXES and isinstance(child, (ast.UnaryOp, ast.Constant))
            if isinstance(child, ast.AST) and not threshold and not axis:
                yield from places(child)


def mutated(text, node, new):
    """A module's text with one node replaced."""
    lines = [line.encode() for line in text.splitlines(keepends=True)]
    begin, end = (sum(map(len, lines[:line - 1])) + column for line, column in (
        (node.lineno, node.col_offset), (node.end_lineno, node.end_col_offset)))
    whole, own = b"".join(lines), ast.unparse(new)
    own = own if isinstance(node, ast.stmt) else f"({own})"
    return (whole[:begin] + own.encode() + whole[end:]).decode()


def module_of(file, root):
    """The numerical module of a file in this package's folder, "robust/fit", or None."""
    if not file.startswith(f"{root}/slamlib/") or not file.endswith(".py"):
        return None
    module = file.removeprefix(f"{root}/slamlib/").removesuffix(".py")
    return module if module.startswith(FOLDERS) else None


def file_of(test):
    """Name of the file of a test, "tests/test_x.py::test_y"."""
    return test.partition("::")[0].rpartition("/")[2]


class Watch:
    """A plugin of pytest: how long every test takes, and the functions that it enters.

    What a test's fixtures enter counts for all tests of its file, which may share them.
    """

    def __init__(self, package):
        self.package, self.entered, self.seconds, self.by_fixtures = package, {}, {}, {}

    def _watch(self, entered):
        def trace(frame, *_):
            entered.add(frame.f_code)
        sys.settrace(trace)

    def _functions(self, codes):
        each = ((module_of(code.co_filename, self.package), code.co_firstlineno) for code in codes)
        return {function for function in each if function[0]}

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_setup(self, item):
        """Watch the fixtures."""
        self._watch(self.by_fixtures.setdefault(item.path.name, set()))
        yield
        sys.settrace(None)

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_call(self, item):
        """Watch the test."""
        self._watch(self.entered.setdefault(item.nodeid, set()))
        begin = time.process_time()
        yield
        sys.settrace(None)
        self.seconds[item.nodeid] = time.process_time() - begin

    def pytest_sessionfinish(self):
        """Keep (seconds, name, functions), the fastest test first."""
        tests = sorted((self.seconds[name], name, self._functions(entered | self.by_fixtures[
            file_of(name)])) for name, entered in self.entered.items())
        (Path(self.package) / "tests.pickle").write_bytes(pickle.dumps(tests))


class Only:
    """A plugin of pytest that runs some tests, in their order."""

    def __init__(self, names):
        self.names = names

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items):
        """Choose them."""
        by_name = {item.nodeid: item for item in items}
        items[:] = [by_name[name] for name in self.names]


def passes(package, files, seconds, plugin):
    """True if the tests in these files pass in time, with the package in this folder.

    In a process of its own, which has no memory of other mutants.
    """
    pid = os.fork()
    if pid:
        return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    silence = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silence, 1)
    os.dup2(silence, 2)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CPU, 2 * (int(seconds),))        # which ends the process
    sys.path.insert(0, package)
    sys.dont_write_bytecode = True
    os.chdir(package)
    os._exit(int(pytest.main(
        ["-x", "-q", "-p", "no:cacheprovider", "-m", "not slow", "-c", str(ROOT / "pyproject.toml"),
         *(str(ROOT / "tests" / file) for file in files)], plugins=[plugin])))


def all_places(only):
    """(module, text, node, function) for all places in modules whose names begin with `only`.

    `function` is the first line of that around the node. It is None outside of functions, and in
    those with decorators, which may be cached: then not all tests that need them enter them.
    """
    found = []
    for file in sorted((ROOT / "slamlib").rglob("*.py")):
        module, text = module_of(str(file), ROOT), file.read_text(encoding="utf-8")
        if module and module.startswith(only):
            tree = ast.parse(text)
            functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
            for node in places(tree):
                around = [each.lineno for each in functions if not each.decorator_list
                          and each.body[0].lineno <= node.lineno <= each.end_lineno]
                found.append((module, text, node, max(around, default=None)))
    return found


def tests_of(tests, module, function):
    """Names of the tests that enter a function, or a module if it is None, for ENOUGH seconds."""
    own = [(seconds, name) for seconds, name, entered in tests if (
        (module, function) in entered if function else any(module == each for each, _ in entered))]
    total, chosen = 0.0, []
    for seconds, name in own:
        total += seconds
        if total < ENOUGH:
            chosen.append(name)
    return chosen, total


def main():
    """Print every survivor, and the share of the others."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=300, help="number of mutants (default 300)")
    parser.add_argument("--seed", type=int, default=0, help="of the draw (default 0)")
    parser.add_argument("--only", default="", help="modules whose name begins so: core, robust/fit")
    given = parser.parse_args()
    rng, found = random.Random(given.seed), all_places(given.only)
    drawn = rng.sample(range(len(found)), min(given.count, len(found)))
    print(f"{len(drawn)} mutants at {len(found)} places", flush=True)
    survivors = 0
    with tempfile.TemporaryDirectory() as package:
        shutil.copytree(ROOT / "slamlib", f"{package}/slamlib",
                        ignore=shutil.ignore_patterns("__pycache__"))
        compileall.compile_dir(package, quiet=1)
        if not passes(package, FILES, 3600, Watch(package)):
            sys.exit("A test fails without a mutant.")
        tests = pickle.loads(Path(package, "tests.pickle").read_bytes())
        for number, k in enumerate(drawn, 1):
            module, text, node, function = found[k]
            new = rng.choice(changes(node))
            names, seconds = tests_of(tests, module, function)
            file = f"slamlib/{module}.py"
            Path(package, file).write_text(mutated(text, node, new), encoding="utf-8")
            files = {*map(file_of, names)}
            if not names or passes(package, files, START + PATIENCE * seconds, Only(names)):
                survivors += 1
                print(f"{number:4} {file}:{node.lineno}: {ast.unparse(node)}   ->   "
                      f"{ast.unparse(new)}", flush=True)
            shutil.copy2(ROOT / file, Path(package, file))
    print(f"{1 - survivors / len(drawn):.0%} are noticed")


if __name__ == "__main__":
    main()
