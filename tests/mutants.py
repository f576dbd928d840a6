"""Mutants: which small defects of the numerics does no test notice?

A mutant is slamlib with one change: an operator, comparison or sign exchanged, a transpose, `wrap`,
root or `not` dropped, a number one more, a statement left out. The fast tests run against
each of some mutants, drawn at random, until one fails; without one that fails, the mutant survives.
Every survivor is a missing test, dead code, or equivalent: no input tells it from the original.
`make mutants` runs this; `make mutants ARGS=robust/fit` on the modules whose names begin so.

Only the bodies of functions change: a threshold of 21 is as good as one of 20.
"""

import ast
import io
import os
import random
import shutil
import subprocess
import sys
import tempfile
import tokenize
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = ("core", "robust", "io")
COUNT = 100    # mutants
# For arrays of real numbers `np.real` changes nothing.
NEW = dict(each.split("~") for each in (
    "+~-;-~+;*~/;/~*;//~*;**~*;&~|;|~&;<~>;>~<;<=~>=;>=~<=;==~!=;!=~==;is~is not;and~or;or~and;"
    "not~;True~False;False~True;T~real;mT~real;abs~real;sqrt~real;unwrap~real;wrap~np.real"
).split(";"))


def places(text):
    """What may change in a module: (row, column) of begin and end, and what stands there then."""
    lines = set()
    for function in ast.walk(ast.parse(text)):
        if not isinstance(function, ast.FunctionDef):
            continue
        lines.update(range(function.body[0].lineno, function.end_lineno + 1))
        for node in ast.walk(function):
            match node:
                case ast.Assign() | ast.AugAssign() | ast.Expr(value=ast.Call()):
                    end = node.end_lineno, node.end_col_offset
                    yield (node.lineno, node.col_offset), end, "pass"
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.start[0] in lines and token.type == tokenize.NUMBER:
            yield token.start, token.end, f"({token.string} + 1)"
        elif token.start[0] in lines and token.string in NEW:
            yield token.start, token.end, NEW[token.string]


def survives(module, text):
    """True if the fast tests pass where a module has this text."""
    with tempfile.TemporaryDirectory() as package:
        shutil.copytree(ROOT / "slamlib", Path(package, "slamlib"))
        Path(package, "slamlib", module).write_text(text)
        try:
            done = subprocess.run(
                [sys.executable, "-m", "pytest", "-qx", "-p", "no:cacheprovider", "-m", "not slow",
                 "-c", ROOT / "pyproject.toml", ROOT / "tests"], cwd=package, capture_output=True,
                timeout=900, env=os.environ | {"PYTHONPATH": package})
        except subprocess.TimeoutExpired:
            return False
    return done.returncode == 0


def mutants(texts):
    """Module, text and difference of all mutants of modules (dict of texts), at random."""
    found = [(module, *place) for module, text in texts.items() for place in places(text)]
    random.Random(0).shuffle(found)
    for module, begin, end, new in found:
        lines = texts[module].splitlines(keepends=True)
        after = lines[end[0] - 1][end[1]:]
        before = lines[begin[0] - 1][:begin[1]]
        text = "".join([*lines[:begin[0] - 1], before, new, after, *lines[end[0]:]])
        try:
            ast.parse(text)
        except SyntaxError:                                      # as of the stars of arguments
            continue
        yield module, text, (
            f"{module}:{begin[0]}:{begin[1]}: {lines[begin[0] - 1].strip()}   ->   {new}")


def main():
    """Print every survivor, and the share of the others."""
    only = "".join(sys.argv[1:])
    source = ROOT / "slamlib"
    names = (f"{folder}/{file.name}" for folder in FOLDERS for file in (source / folder).glob("*"))
    texts = {name: (source / name).read_text() for name in sorted(names)
             if name.startswith(only) and name.endswith(".py")}
    if not survives("__init__.py", (source / "__init__.py").read_text()):
        sys.exit("A test fails without a mutant.")
    drawn = [*islice(mutants(texts), COUNT)]
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        survived = [*threads.map(lambda mutant: survives(*mutant[:2]), drawn)]
    print(*(difference for (*_, difference), unnoticed in zip(drawn, survived) if unnoticed),
          sep="\n")
    print(f"{len(drawn) - sum(survived)} of {len(drawn)} are noticed")


if __name__ == "__main__":
    main()
