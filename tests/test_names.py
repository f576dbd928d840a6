"""Names and records of the package, by its syntax."""

import ast
import io
import tokenize

from test_structure import FILES, MODULES, name_of

TEXTS = {name_of(file): file.read_text(encoding="utf-8") for file in FILES}


def defined(module):
    """Public names that a module defines at its top: {name: its function, class or assignment}."""
    found = {}
    for node in MODULES[module].body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            found[node.name] = node
        elif isinstance(node, ast.Assign):
            found |= {each.id: node for target in node.targets for each in ast.walk(target)
                      if isinstance(each, ast.Name)}
    return {name: node for name, node in found.items() if not name.startswith("_")}


def test_a_public_name_is_defined_once_and_no_module_has_it():
    """Also where a package gathers what its modules define."""
    owner, modules = {}, {name.rpartition(".")[2] for name in MODULES}
    for module in MODULES:
        for name, node in defined(module).items():
            assert isinstance(node, ast.Assign) or name not in modules, (module, name)
            assert owner.setdefault(name, module) == module, (module, name)


def test_every_number_with_a_name_has_a_comment():
    """On its line or on the line above."""
    found = []
    for module, text in TEXTS.items():
        lines = {token.start[0] for token in tokenize.generate_tokens(io.StringIO(text).readline)
                 if token.type == tokenize.COMMENT}
        for node in MODULES[module].body:
            parts = [*ast.walk(node.value)] if isinstance(node, ast.Assign) else []
            constants = [each.value for each in parts if isinstance(each, ast.Constant)]
            if constants and all(type(value) in (int, float) for value in constants) \
                    and not any(isinstance(each, ast.Subscript) for each in parts):
                found += [(module, node.lineno)] * lines.isdisjoint(
                    range(node.lineno - 1, node.end_lineno + 1))
    assert found == []


def test_dataclasses_are_frozen():
    made = [(module, ast.unparse(decorator)) for module, tree in MODULES.items()
            for node in ast.walk(tree) if isinstance(node, ast.ClassDef)
            for decorator in node.decorator_list if "dataclass" in ast.unparse(decorator)]
    assert len(made) > 20 and all("frozen=True" in decorator for _, decorator in made)
