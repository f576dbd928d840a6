"""Names and records of the package, by its syntax: each rule is held module by module."""

import ast
import io
import re
import tokenize

import pytest
from test_structure import FILES, MODULES, name_of

TEXTS = {name_of(file): file.read_text(encoding="utf-8") for file in FILES}
MODULE_NAMES = {name.rpartition(".")[2] for name in MODULES}
PREPOSITIONS = set("about at of by in on to from with for within near over under before after "
                   "between".split())
ALLOWED = {("slamlib.se2", "between")}                # the field's name of this function
MOST = 4                                              # values by position: of a record, of a tuple

each_module = pytest.mark.parametrize("module", MODULES)


def top_level(body):
    """Statements of a module, those in `if`, `try` and `with` too."""
    for node in body:
        yield node
        for part in ("body", "orelse", "finalbody", "handlers"):
            if isinstance(node, (ast.If, ast.Try, ast.With, ast.ExceptHandler)):
                yield from top_level(getattr(node, part, []))


def targets(node):
    """Names that an assignment binds, in tuples too."""
    given = node.targets if isinstance(node, ast.Assign) else [node.target]
    return [each.id for target in given for each in ast.walk(target)
            if isinstance(each, ast.Name) and isinstance(each.ctx, ast.Store)]


def defined(tree):
    """What a module defines at its top, (name, whether it is a function or a class)."""
    found = set()
    for node in top_level(tree.body):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            found.add((node.name, True))
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            found |= {(name, False) for name in targets(node)}
    return {each for each in found if not each[0].startswith("_")}


def bound(tree):
    """Every parameter, variable, field and function of a module, as (line, name)."""
    for node in ast.walk(tree):
        if isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id
        elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            yield node.lineno, node.name


def numeric(node):
    """Whether an expression is a number, or numbers in a tuple, list or array."""
    if isinstance(node, ast.Constant):
        return isinstance(node.value, (int, float)) and not isinstance(node.value, bool)
    parts = {ast.UnaryOp: lambda: [node.operand], ast.BinOp: lambda: [node.left, node.right],
             ast.Tuple: lambda: node.elts, ast.List: lambda: node.elts,
             ast.Call: lambda: node.args}.get(type(node), lambda: [])()
    return any(map(numeric, parts)) and not any(
        isinstance(each, ast.Constant) and isinstance(each.value, (str, bytes))
        for part in parts for each in ast.walk(part))


def commented(text):
    """The lines of a text that have a comment."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return {token.start[0] for token in tokens if token.type == tokenize.COMMENT}


def dataclass_decorator(node):
    """The decorator, as text, that makes a class a dataclass; "" if none does."""
    return next((text for text in map(ast.unparse, node.decorator_list)
                 if re.match(r"(dataclasses\.)?dataclass\b", text)), "")


def records():
    """Numbers of fields of all dataclasses and named tuples by name, with those they inherit."""
    classes = {node.name: node for tree in MODULES.values() for node in ast.walk(tree)
               if isinstance(node, ast.ClassDef)}

    def count(name):
        node = classes.get(name)
        return 0 if node is None else sum(
            isinstance(each, ast.AnnAssign) and "ClassVar" not in ast.unparse(each.annotation)
            for each in node.body) + sum(count(ast.unparse(base)) for base in node.bases)

    return {name: count(name) for name, node in classes.items() if dataclass_decorator(node)
            or "NamedTuple" in map(ast.unparse, node.bases)}


FIELDS = records()


def by_position(tree, inside=None):
    """Calls that build a record of many fields with arguments by position, as (line, name)."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Call) and node.args:
            name = getattr(node.func, "id", getattr(node.func, "attr", ""))
            name = inside if name == "cls" else name
            if FIELDS.get(name, 0) > MOST:
                yield node.lineno, name
        yield from by_position(node, node.name if isinstance(node, ast.ClassDef) else inside)


def returned(node):
    """The expressions that a statement `return` may return."""
    value = node.value
    return [value.body, value.orelse] if isinstance(value, ast.IfExp) else [value]


def test_the_walk_sees_what_there_is():
    """In a module of its own that breaks every rule; else a rule that sees nothing would hold."""
    text = ('A, B = 1.5, 2\nC = (1, -2)\nD = ("#", 1)  # text\nif A:\n    E = np.radians(3)\n'
            "class Q:\n    def make(cls, /, at, *by, to=1, **of):\n        return cls(1, 2)\n"
            "def f():\n    for a, near in b:\n        with c as over:\n"
            "            [d for within in e]\n    return 1, 2, 3, 4, *g\n")
    tree = ast.parse(text)
    assert {name for name, _ in defined(tree)} == set("ABCDEQf")
    assert {name for _, name in bound(tree)} & PREPOSITIONS == {
        "at", "by", "to", "of", "near", "over", "within"}
    constants = [node for node in top_level(tree.body) if isinstance(node, ast.Assign)]
    assert [numeric(node.value) for node in constants] == [True, True, False, True]
    assert commented(text) == {3}
    assert FIELDS["Dataset"] > MOST and "Progress" not in FIELDS
    text = "f(Dataset(a, b=1), x.Dataset(*c), Dataset(**d))\nclass Dataset:\n    z = cls(1)"
    assert list(by_position(ast.parse(text))) == [(1, "Dataset"), (1, "Dataset"), (3, "Dataset")]


@each_module
def test_no_function_or_class_has_the_name_of_a_module(module):
    """A name stands for one of both, also where a package gathers what its modules define."""
    made = {name for name, callable_ in defined(MODULES[module]) if callable_}
    assert sorted(made & MODULE_NAMES) == []


@each_module
def test_a_public_name_is_defined_in_one_module(module):
    own = {name for name, _ in defined(MODULES[module])}
    twice = {name: other for other, tree in MODULES.items() if other != module
             for name, _ in defined(tree) if name in own}
    assert twice == {}


@each_module
def test_no_parameter_variable_or_function_is_a_bare_preposition(module):
    found = {(line, name) for line, name in bound(MODULES[module])
             if name.strip("_") in PREPOSITIONS and (module, name) not in ALLOWED}
    assert sorted(found) == []


def test_a_preposition_that_is_the_field_s_term_is_used():
    """Else it need not be allowed."""
    for module, name in ALLOWED:
        assert name in {each for _, each in bound(MODULES[module])}


@each_module
def test_every_number_with_a_name_has_a_comment(module):
    """On its line or on the line above."""
    lines = commented(TEXTS[module])
    found = [(node.lineno, *targets(node)) for node in top_level(MODULES[module].body)
             if isinstance(node, (ast.Assign, ast.AnnAssign)) and numeric(node.value)
             and not lines.intersection(range(node.lineno - 1, node.end_lineno + 1))]
    assert found == []


@each_module
def test_dataclasses_are_frozen(module):
    found = [node.name for node in ast.walk(MODULES[module]) if isinstance(node, ast.ClassDef)
             and dataclass_decorator(node) and "frozen=True" not in dataclass_decorator(node)]
    assert found == []


@each_module
def test_records_of_many_fields_are_built_with_keywords(module):
    assert list(by_position(MODULES[module])) == []


@each_module
def test_no_function_returns_many_values_by_position(module):
    found = [node.lineno for node in ast.walk(MODULES[module]) if isinstance(node, ast.Return)
             for value in returned(node) if isinstance(value, ast.Tuple) and len(value.elts) > MOST]
    assert found == []


@each_module
def test_no_attribute_is_reached_behind_a_record_s_back(module):
    found = [(node.lineno, node.attr) for node in ast.walk(MODULES[module])
             if isinstance(node, ast.Attribute) and node.attr in ("__dict__", "__setattr__")]
    assert found == []
