"""Names and records of the package, by its syntax."""

import ast
import io
import re
import tokenize

from test_structure import FILES, MODULES, name_of

TEXTS = {name_of(file): file.read_text(encoding="utf-8") for file in FILES}
PREPOSITIONS = set("about at of by in on to from with for within near over under before after "
                   "between".split())
ALLOWED = {("slamlib.se2", "between")}                # the field's name of this function
MOST = 4                                              # values by position: of a record, of a tuple
NODES = [(module, node) for module, tree in MODULES.items() for node in ast.walk(tree)]
CLASSES = {node.name: node for _, node in NODES if isinstance(node, ast.ClassDef)}


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


def defined(module):
    """Public names that a module defines at its top: {name: whether it is a function or class}."""
    found = {}
    for node in top_level(MODULES[module].body):
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            found[node.name] = True
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            found |= dict.fromkeys(targets(node), False)
    return {name: made for name, made in found.items() if not name.startswith("_")}


def numeric(node):
    """Whether an expression is a number, or numbers in a tuple, list or array."""
    if isinstance(node, ast.Constant):
        return isinstance(node.value, (int, float)) and not isinstance(node.value, bool)
    parts = {ast.UnaryOp: "operand", ast.Tuple: "elts", ast.List: "elts", ast.Call: "args"}
    inner = getattr(node, parts.get(type(node), ""), [])
    inner = [node.left, node.right] if isinstance(node, ast.BinOp) else inner
    return any(map(numeric, inner if isinstance(inner, list) else [inner])) and not any(
        isinstance(each, ast.Constant) and isinstance(each.value, (str, bytes))
        for each in ast.walk(node))


def dataclass_decorator(node):
    """The decorator, as text, that makes a class a dataclass; "" if none does."""
    return next((text for text in map(ast.unparse, node.decorator_list)
                 if re.match(r"(dataclasses\.)?dataclass\b", text)), "")


def fields(name):
    """Number of fields of a dataclass or named tuple, with those it inherits; 0 of all others."""
    node = CLASSES.get(name)
    if node is None or not (dataclass_decorator(node) or "NamedTuple" in map(
            ast.unparse, node.bases)):
        return 0
    return sum(isinstance(each, ast.AnnAssign) for each in node.body) + sum(
        fields(ast.unparse(base)) for base in node.bases)


def test_a_public_name_is_defined_once_and_no_module_has_it():
    """Also where a package gathers what its modules define."""
    owner, modules = {}, {name.rpartition(".")[2] for name in MODULES}
    for module in MODULES:
        for name, made in defined(module).items():
            assert not (made and name in modules), (module, name)
            assert owner.setdefault(name, module) == module, (module, name)


def test_no_parameter_variable_or_function_is_a_bare_preposition():
    found = [(module, node.lineno, name) for module, node in NODES for name in [
        node.arg if isinstance(node, ast.arg) else
        node.id if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) else
        getattr(node, "name", None) if isinstance(node, ast.FunctionDef) else None]
        if name and name.strip("_") in PREPOSITIONS and (module, name) not in ALLOWED]
    assert found == []


def test_every_number_with_a_name_has_a_comment():
    """On its line or on the line above."""
    found = []
    for module, text in TEXTS.items():
        lines = {token.start[0] for token in tokenize.generate_tokens(io.StringIO(text).readline)
                 if token.type == tokenize.COMMENT}
        found += [(module, node.lineno) for node in top_level(MODULES[module].body)
                  if isinstance(node, (ast.Assign, ast.AnnAssign)) and numeric(node.value)
                  and not lines.intersection(range(node.lineno - 1, node.end_lineno + 1))]
    assert found == []


def test_dataclasses_are_frozen_and_many_fields_are_given_by_keyword():
    for name, node in CLASSES.items():
        assert "frozen=True" in (dataclass_decorator(node) or "frozen=True"), name
    assert [(module, node.lineno) for module, node in NODES
            if isinstance(node, ast.Call) and node.args and fields(
                getattr(node.func, "id", getattr(node.func, "attr", ""))) > MOST] == []


def test_no_function_returns_many_values_by_position():
    found = [(module, node.lineno) for module, node in NODES if isinstance(node, ast.Return)
             for value in [getattr(node.value, "body", node.value),
                           getattr(node.value, "orelse", None)]
             if isinstance(value, ast.Tuple) and len(value.elts) > MOST]
    assert found == []
