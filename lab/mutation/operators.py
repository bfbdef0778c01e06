"""Mutation operators: small changes of the syntax tree, each of which a test should notice.

An operator returns the nodes that may replace one node. Error sentences, log messages, assertions
and annotations are left alone: no test should depend on the wording.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from enum import Enum
from types import ModuleType

Replacement = tuple[str, ast.AST]
"""Name of the operator, and the node that replaces the present one."""
NEGATIONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.GtE,
    ast.LtE: ast.Gt,
    ast.Gt: ast.LtE,
    ast.GtE: ast.Lt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
"""A bound is not moved (< to <=): of a continuous quantity, this changes a single value."""
TWINS = {"any": "all", "all": "any", "min": "max", "max": "min"}
SYMMETRIC = frozenset({"min", "max"})


def replacements(node: ast.AST, module: ModuleType) -> Iterator[Replacement]:
    """Return all replacements of a node, without those of its children.

    ``module``: the imported module of the node, in which the names of enums are looked up.
    """
    if isinstance(node, ast.If | ast.While | ast.IfExp):
        yield from _conditions(node)
    elif isinstance(node, ast.For):
        yield "first", _copy(node, iter=_call("list", node.iter, first=True))
    elif isinstance(node, ast.BoolOp):
        if any(_is_text(value) for value in node.values):
            return
        for index in range(len(node.values)):
            left = [value for at, value in enumerate(node.values) if at != index]
            yield "operand", left[0] if len(left) == 1 else _copy(node, values=left)
    elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub):
        if _is_text(node.left) or _is_text(node.right):
            return
        other = ast.Sub() if isinstance(node.op, ast.Add) else ast.Add()
        yield "operand", node.left
        yield "swap", _copy(node, op=other)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield "not", node.operand
    elif isinstance(node, ast.Compare):
        for index, op in enumerate(node.ops):
            negated = NEGATIONS[type(op)]()
            yield "compare", _copy(node, ops=[*node.ops[:index], negated, *node.ops[index + 1 :]])
    elif isinstance(node, ast.Call):
        yield from _calls(node)
    elif isinstance(node, ast.Constant):
        for value in _values(node.value):
            yield "value", ast.Constant(value)
    elif isinstance(node, ast.Attribute):
        yield from _members(node, module)
    elif isinstance(node, ast.stmt):
        yield from _statements(node)


def _conditions(node: ast.If | ast.While | ast.IfExp) -> Iterator[Replacement]:
    """Force a condition. A loop that never ends would only show that the time is limited."""
    yield "false", _copy(node, test=ast.Constant(False))
    if not isinstance(node, ast.While):
        yield "true", _copy(node, test=ast.Constant(True))


def _calls(node: ast.Call) -> Iterator[Replacement]:
    name = node.func.id if isinstance(node.func, ast.Name) else ""
    if name in TWINS:
        yield "swap", _copy(node, func=ast.Name(TWINS[name], ast.Load()))
    if name in SYMMETRIC and len(node.args) > 1:
        for index in range(len(node.args)):
            rest = [argument for at, argument in enumerate(node.args) if at != index]
            yield "operand", rest[0] if len(rest) == 1 else _copy(node, args=rest)


def _values(value: object) -> tuple[object, ...]:
    """Return the neighbours of a constant."""
    if isinstance(value, bool):
        return (not value,)
    if isinstance(value, int):
        return (1,) if value == 0 else (2 * value, value // 2)
    if isinstance(value, float):
        return (1.0,) if value == 0.0 else (2 * value, value / 2)
    return ()


def _members(node: ast.Attribute, module: ModuleType) -> Iterator[Replacement]:
    """Replace a member of an enum, or a constant of a message, by the next one of its class that
    has another value."""
    if not (isinstance(node.value, ast.Name) and isinstance(node.ctx, ast.Load)):
        return
    owner = getattr(module, node.value.id, None)
    if isinstance(owner, type) and owner.__name__ != "ErrorCode" and node.attr.isupper():
        constants = owner.__members__ if issubclass(owner, Enum) else vars(owner)
        names = [name for name in constants if name.isupper() and name != "ROS_TYPE"]
        at = names.index(node.attr) if node.attr in names else 0
        for following in (*names[at + 1 :], *names[:at]):
            if getattr(owner, following) != getattr(owner, node.attr):
                yield "member", _copy(node, attr=following)
                break


def _statements(node: ast.stmt) -> Iterator[Replacement]:
    """Drop a statement that acts. Dropping the only assignment of a local name fails at once, so
    only assignments to attributes and elements are dropped."""
    if isinstance(node, ast.Expr | ast.AugAssign | ast.Break | ast.Continue):
        yield "drop", ast.Pass()
    elif isinstance(node, ast.Assign):
        kept = [t for t in node.targets if not isinstance(t, ast.Attribute | ast.Subscript)]
        for target in node.targets:
            if target in kept:
                continue
            rest = [other for other in node.targets if other is not target]
            yield "drop", _copy(node, targets=rest) if rest else ast.Expr(node.value)


def _call(name: str, argument: ast.expr, first: bool) -> ast.expr:
    """Return ``name(argument)``, or its first element only (``[:1]``)."""
    made: ast.expr = ast.Call(ast.Name(name, ast.Load()), [argument], [])
    if first:
        made = ast.Subscript(made, ast.Slice(upper=ast.Constant(1)), ast.Load())
    return made


def _copy(node: ast.AST, **changed: object) -> ast.AST:
    """Return a shallow copy of a node with changed fields."""
    fields = {name: getattr(node, name, None) for name in node._fields} | changed
    return ast.copy_location(type(node)(**fields), node)


def children(node: ast.AST) -> Iterator[tuple[str, int | None, ast.AST]]:
    """Return the children of a node that may be changed: field, index in the field, and child."""
    for field, value in ast.iter_fields(node):
        if field in ("decorator_list", "returns", "annotation", "args") and not isinstance(
            node, ast.Call
        ):
            continue
        if isinstance(node, ast.Subscript) and field == "slice":
            continue
        if isinstance(node, ast.AugAssign) and field == "value":
            continue
        for index, child in enumerate(value if isinstance(value, list) else [value]):
            if isinstance(child, ast.AST) and not _is_left_alone(child):
                yield field, index if isinstance(value, list) else None, child


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.JoinedStr) or (
        isinstance(node, ast.Constant) and isinstance(node.value, str)
    )


def _is_left_alone(node: ast.AST) -> bool:
    if isinstance(node, ast.Expr):
        call = node.value.value if isinstance(node.value, ast.Yield) else node.value
        logs = isinstance(call, ast.Call) and ast.unparse(call.func).endswith(("._log", "Log"))
        return logs or isinstance(call, ast.Constant)
    if isinstance(node, ast.IfExp):
        return _is_text(node.body) and _is_text(node.orelse)
    if isinstance(node, ast.Call):
        # The arguments of a sentence's format.
        return isinstance(node.func, ast.Attribute) and node.func.attr in ("format", "join")
    return isinstance(node, ast.JoinedStr | ast.Assert | ast.Raise)
