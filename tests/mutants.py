"""Mutants: which small defects of the numerics does no test notice?

A mutant is slamlib with one change: an operator or comparison exchanged, a transpose, `wrap`, root,
sign or `not` dropped, a number one more or less, a statement left out. The fast tests run against
each of some mutants, drawn at random, until one fails; without one that fails, the mutant survives.
Every survivor is a missing test, dead code, or equivalent: no input tells it from the original.
`make mutants` runs this; `make mutants ARGS="--only robust --count 50"` a part of it.

Left out are the values of names in capital letters, since a threshold of 21 is as good as one of
20, and messages.
"""

import argparse
import ast
import os
import random
import resource
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = ("core", "robust", "io")
LONGEST = 900                           # s, of the tests of one mutant
SWAPS = {ast.Add: ast.Sub, ast.Mult: ast.Div, ast.BitAnd: ast.BitOr, ast.And: ast.Or,
         ast.Lt: ast.Gt, ast.LtE: ast.GtE, ast.Eq: ast.NotEq, ast.Is: ast.IsNot, ast.In: ast.NotIn}
SWAPS |= {other: one for one, other in SWAPS.items()} | {ast.Pow: ast.Mult, ast.FloorDiv: ast.Mult}
DROPPED = {"wrap", "unwrap", "swapaxes", "transpose", "abs", "sqrt"}


def changed(node, **fields):
    return type(node)(**vars(node) | fields)


def changes(node):
    """What may replace a node of the syntax tree: a list of nodes."""
    match node:
        case ast.BinOp(op=op) | ast.BoolOp(op=op) if type(op) in SWAPS:
            return [changed(node, op=SWAPS[type(op)]())]
        case ast.Compare(ops=[op, *rest]) if type(op) in SWAPS:
            return [changed(node, ops=[SWAPS[type(op)](), *rest])]
        case ast.UnaryOp(operand=inner) | ast.Attribute(attr="T" | "mT", value=inner):
            return [inner]
        case ast.Constant(value=bool(value)):
            return [ast.Constant(not value)]
        case ast.Constant(value=int(value) | float(value)):
            return [ast.Constant(value + 1), ast.Constant(value - 1)]
        case ast.Call(func=ast.Name(name) | ast.Attribute(attr=name), args=[inner, *_]):
            return [inner] if name in DROPPED else []
        case ast.Assign() | ast.AugAssign() | ast.Expr(value=ast.Call()):
            return [ast.Pass()]
    return []


def places(tree):
    """Nodes in functions that may be changed."""
    messages = {node for text in ast.walk(tree) if isinstance(text, ast.Raise | ast.JoinedStr)
                for node in ast.walk(text)}
    found = {node: None for function in ast.walk(tree) if isinstance(function, ast.FunctionDef)
             for statement in function.body for node in ast.walk(statement) if changes(node)}
    return [node for node in found if node not in messages]


class Replaced(ast.NodeTransformer):
    """Replaces one node of a tree by another."""

    def __init__(self, node, new):
        self.node, self.new = node, new

    def visit(self, node):
        """The other node in the place of the one."""
        return self.new if node is self.node else self.generic_visit(node)


def survives(module, text):
    """True if the fast tests pass where a module has this text."""
    with tempfile.TemporaryDirectory() as package:
        shutil.copytree(ROOT / "slamlib", Path(package, "slamlib"))
        Path(package, "slamlib", module).write_text(text, encoding="utf-8")
        try:
            done = subprocess.run(
                [sys.executable, "-m", "pytest", "-qx", "-p", "no:cacheprovider", "-m", "not slow",
                 "-c", ROOT / "pyproject.toml", ROOT / "tests"], cwd=package, capture_output=True,
                timeout=LONGEST, env=os.environ | {"PYTHONPATH": package})
        except subprocess.TimeoutExpired:
            return False
    return done.returncode == 0


def mutants(trees, count, seed):
    """Module, text and difference of mutants that are drawn from the trees of modules (dict)."""
    rng = random.Random(seed)
    found = [(module, node) for module, tree in trees.items() for node in places(tree)]
    for module, node in rng.sample(found, min(count, len(found))):
        new = rng.choice(changes(node))
        text = ast.unparse(Replaced(node, new).visit(trees[module]))
        Replaced(new, node).visit(trees[module])
        yield module, text, (
            f"{module}:{node.lineno}: {ast.unparse(node)}   ->   {ast.unparse(new)}")


def main():
    """Print every survivor, and the share of the others."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=100, help="number of mutants (default 100)")
    parser.add_argument("--seed", type=int, default=0, help="of the draw (default 0)")
    parser.add_argument("--only", default="", help="modules whose name begins so: core, robust/fit")
    given = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))             # bytes
    source = ROOT / "slamlib"
    files = {f"{folder}/{file.name}": file for folder in FOLDERS
             for file in sorted((source / folder).glob("*.py"))}
    trees = {module: ast.parse(file.read_text(encoding="utf-8")) for module, file in files.items()
             if module.startswith(given.only)}
    if not survives("solve.py", (source / "solve.py").read_text(encoding="utf-8")):
        sys.exit("A test fails without a mutant.")
    drawn = [*mutants(trees, given.count, given.seed)]
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        survived = [*threads.map(lambda mutant: survives(*mutant[:2]), drawn)]
    print(*(difference for (*_, difference), unnoticed in zip(drawn, survived) if unnoticed),
          sep="\n")
    print(f"{len(drawn) - sum(survived)} of {len(drawn)} are noticed")


if __name__ == "__main__":
    main()
