"""Mutants of a module: their enumeration with stable ids, and planting one in this process.

A mutant replaces the code of one function, or one numeric constant of the module, in the modules
that are already imported. No file is changed. A process that has planted a mutant runs nothing
else; the callers fork one for each mutant.
"""

from __future__ import annotations

import ast
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from types import CodeType, FunctionType, ModuleType

from lab.mutation.operators import children, replacements

Function = ast.FunctionDef | ast.AsyncFunctionDef


class CannotPlant(Exception):
    """The changed function cannot replace the present one."""


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change of a module: child ``field[index]`` of ``parent`` becomes ``new``."""

    name: str
    """``module:function:line in the function:operator:number``, such as
    ``logic.tapper:TapperLogic.check_firing:14:false:0``. Lines count from the ``def``."""
    place: Function | ast.Assign
    """Outermost function that contains the change, or assignment of a constant of the module."""
    parent: ast.AST
    field: str
    index: int | None
    new: ast.AST
    lines: range
    """Lines of the statement that is changed, without the body of a compound statement."""

    @property
    def old(self) -> ast.AST:
        """Node that is replaced."""
        value = getattr(self.parent, self.field)
        found = value if self.index is None else value[self.index]
        assert isinstance(found, ast.AST)
        return found

    def change(self) -> str:
        """Return the change as text on one line."""
        old, new = (" ".join(_headline(node).split()) for node in (self.old, self.new))
        return f"{old} -> {new}"


class Source:
    """Source of an imported module, and its mutants."""

    def __init__(self, module: ModuleType) -> None:
        assert module.__file__ is not None
        self.module, self.file = module, module.__file__
        self.name = module.__name__.partition(".")[2]
        with open(self.file, encoding="utf-8") as opened:
            self.tree = ast.parse(opened.read())

    @cached_property
    def mutants(self) -> list[Mutant]:
        """All mutants, in the order of the source."""
        made: list[Mutant] = []
        numbers: Counter[str] = Counter()
        for title, place in self._places():
            for parent, field, index, node, lines in _walk(place, place):
                is_forced = field == "test" and isinstance(node, ast.Compare)
                for operator, new in replacements(node, self.module):
                    if operator == "drop" and title.endswith("__init__"):
                        continue  # the next use of the attribute fails
                    if is_forced:
                        break  # the whole condition, which is forced both ways
                    base = f"{self.name}:{title}:{lines.start - place.lineno}:{operator}"
                    name = f"{base}:{numbers[base]}"
                    numbers[base] += 1
                    made.append(Mutant(name, place, parent, field, index, new, lines))
        return made

    def _places(self) -> Iterator[tuple[str, Function | ast.Assign]]:
        """Return the name and the node of each outermost function and numeric constant."""
        for node in self.tree.body:
            if isinstance(node, ast.ClassDef):
                for inner in node.body:
                    if isinstance(inner, Function):
                        yield f"{node.name}.{inner.name}", inner
            elif isinstance(node, Function):
                yield node.name, node
            elif isinstance(node, ast.Assign) and constant_of(node) in vars(self.module):
                yield constant_of(node), node

    def plant(self, mutant: Mutant) -> None:
        """Apply a mutant in this process, for ever.

        Raises:
            CannotPlant: the changed code cannot replace the present one.
        """
        value = getattr(mutant.parent, mutant.field)
        if mutant.index is None:
            setattr(mutant.parent, mutant.field, mutant.new)
        else:
            value[mutant.index] = mutant.new
        ast.fix_missing_locations(self.tree)
        try:
            code = compile(self.tree, self.file, "exec")
        except SyntaxError as error:
            raise CannotPlant(str(error)) from error
        if isinstance(mutant.place, ast.Assign):
            self._replace_constant(mutant.place)
            return
        key = mutant.place.name, _first_line(mutant.place)
        try:
            _functions(self.module)[key].__code__ = _find(code, key)
        except (KeyError, ValueError) as error:
            raise CannotPlant(f"{mutant.name}: {error}") from error

    def _replace_constant(self, assignment: ast.Assign) -> None:
        """Evaluate a constant again, and replace it wherever it was imported by its name."""
        name = constant_of(assignment)
        old = vars(self.module)[name]
        expression = compile(ast.Expression(assignment.value), self.file, "eval")
        new = eval(expression, dict(vars(self.module)))
        for module in list(sys.modules.values()):
            if getattr(module, "__dict__", {}).get(name) is old:
                setattr(module, name, new)


def constant_of(node: ast.Assign) -> str:
    """Return the name of a numeric constant of a module; "" if the assignment is none."""
    target = node.targets[0]
    numeric = all(
        isinstance(part, ast.BinOp | ast.operator | ast.Name | ast.expr_context)
        or (isinstance(part, ast.Constant) and isinstance(part.value, int | float))
        for part in ast.walk(node.value)
    )
    return target.id if numeric and isinstance(target, ast.Name) and target.id.isupper() else ""


def _walk(
    parent: ast.AST, statement: ast.stmt
) -> Iterator[tuple[ast.AST, str, int | None, ast.AST, range]]:
    """Return all nodes below a node with their parents and the lines of their statements."""
    for field, index, child in children(parent):
        inner = child if isinstance(child, ast.stmt) else statement
        yield parent, field, index, child, _lines(inner)
        yield from _walk(child, inner)


def _lines(statement: ast.stmt) -> range:
    end = statement.end_lineno or statement.lineno
    body = getattr(statement, "body", None)
    return range(statement.lineno, (body[0].lineno if body else end + 1))


def _headline(node: ast.AST) -> str:
    """Return the source of a node; of a compound statement, only its first line."""
    text = ast.unparse(node)
    return text.split("\n")[0] if isinstance(node, ast.If | ast.For | ast.While) else text


def _first_line(function: Function) -> int:
    return min([function.lineno, *(node.lineno for node in function.decorator_list)])


def _functions(module: ModuleType) -> dict[tuple[str, int], FunctionType]:
    """Return the functions and methods that a module defines, by name and first line."""
    found: dict[tuple[str, int], FunctionType] = {}
    pending, seen = list(vars(module).values()), set[int]()
    while pending:
        thing = pending.pop()
        if id(thing) in seen:
            continue
        seen.add(id(thing))
        if isinstance(thing, type) and thing.__module__ == module.__name__:
            pending += vars(thing).values()
        elif isinstance(thing, FunctionType) and thing.__code__.co_filename == module.__file__:
            found[thing.__name__, thing.__code__.co_firstlineno] = thing
        else:
            wrapped = ("fget", "fset", "func", "__func__", "__wrapped__")
            pending += [getattr(thing, name) for name in wrapped if hasattr(thing, name)]
    return found


def _find(code: CodeType, key: tuple[str, int]) -> CodeType:
    """Return the code of the function with this name and first line."""
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            if (constant.co_name, constant.co_firstlineno) == key:
                return constant
            if constant.co_firstlineno <= key[1]:
                try:
                    return _find(constant, key)
                except KeyError:
                    continue
    raise KeyError(key)
