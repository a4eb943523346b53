"""The small ways in which a function is broken: one change a mutant, told by line and by what was changed."""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import CodeType, FunctionType, ModuleType
from typing import Any

__all__ = ["Mutant", "mutants_of", "mutants_of_constant"]

_COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
_ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
}
_OTHER_CALL = {"min": "max", "max": "min", "all": "any", "any": "all", "abs": "float"}
_SIGNS: dict[type[ast.AST], str] = {
    ast.Lt: "<",
    ast.LtE: "<=",
    ast.Gt: ">",
    ast.GtE: ">=",
    ast.Eq: "==",
    ast.NotEq: "!=",
    ast.Is: "is",
    ast.IsNot: "is not",
    ast.In: "in",
    ast.NotIn: "not in",
    ast.Add: "+",
    ast.Sub: "-",
    ast.Mult: "*",
    ast.Div: "/",
    ast.And: "and",
    ast.Or: "or",
}


@dataclass(frozen=True)
class Mutant:
    """One broken version of a function, or of a constant that functions read.

    Attributes:
        function: Its name with its module's.
        line: Where in the file.
        change: What was changed, such as ``< becomes <=``.
        source: The line as it stands in the file.
        code: The broken function's code, which takes the place of the whole one's; None for a constant.
        value: What a constant becomes.
    """

    function: str
    line: int
    change: str
    source: str
    code: CodeType | None
    value: int | float = 0

    @property
    def key(self) -> str:
        """What a list of equivalent mutants names it by: no line numbers, which move."""
        return f"{self.function}: {self.source}: {self.change}"


def mutants_of(function: FunctionType, name: str) -> Iterator[Mutant]:
    """Yield every mutant of a function that compiles to other code.

    Args:
        function: The function itself, not a bound method.
        name: What it is called in tables.
    """
    try:
        lines, first = inspect.getsourcelines(function)
    except OSError:
        return  # made at run time, such as a NamedTuple's methods
    # Each line where it stands in the file.
    source = "\n" * (first - 1) + textwrap.dedent("".join(lines))
    tree = ast.parse(source)
    if not isinstance(tree.body[0], (ast.FunctionDef, ast.AsyncFunctionDef)):
        return  # made by a decorator, such as a dataclass's __init__
    seen = {function.__code__.co_code}
    told_before: Counter[tuple[int, str]] = Counter()
    for number, _ in enumerate(_changes(tree)):
        broken = ast.parse(source)
        line, change = next(told() for index, told in enumerate(_changes(broken)) if index == number)
        code = _code_of(broken, function)
        if code is None or (code.co_code in seen and code.co_consts == function.__code__.co_consts):
            continue
        told_before[line, change] += 1
        count = told_before[line, change]
        change += f" (number {count} of the line)" if count > 1 else ""
        yield Mutant(name, line, change, lines[line - first].strip(), code)


def mutants_of_constant(module: ModuleType, name: str) -> Iterator[Mutant]:
    """Yield a number of a module as one, where it is a count, and else as its double."""
    whole = getattr(module, name)
    value = 1 if isinstance(whole, int) else 2.0 * whole
    lines = inspect.getsource(module).splitlines()
    line = next(number for number, text in enumerate(lines, 1) if text.startswith(f"{name} = "))
    yield Mutant(name, line, f"{whole} becomes {value}", lines[line - 1], None, value)


def _changes(tree: ast.Module) -> Iterator[Callable[[], tuple[int, str]]]:
    """Yield what makes one change in place and tells its line and what it was."""
    top = tree.body[0]
    assert isinstance(top, (ast.FunctionDef, ast.AsyncFunctionDef))
    docstring = top.body[0] if ast.get_docstring(top) is not None else None
    for statement in top.body:
        is_words = isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)
        if statement is docstring or is_words:
            continue
        for node in _walk(statement):
            yield from _of_expression(node)
            yield from _of_block(node)
            if isinstance(node, ast.With):
                yield from _of_with(node)
    block = top.body
    # At its end a function returns nothing by itself.
    nothing = isinstance(block[-1], ast.Return) and getattr(block[-1].value, "value", 0) in {None, ""}
    yield from _of_list(block[:-1] if nothing else block, docstring, block)


def _walk(node: ast.AST) -> Iterator[ast.AST]:
    """Walk a tree, but not into what only words or checks of types are made of: assertions, texts and annotations."""
    if isinstance(node, (ast.Assert, ast.JoinedStr)):
        return
    yield node
    annotation = getattr(node, "annotation", None)
    for child in ast.iter_child_nodes(node):
        if child is not annotation:
            yield from _walk(child)


def _of_expression(node: ast.AST) -> Iterator[Callable[[], tuple[int, str]]]:
    if isinstance(node, ast.Compare):
        for index, operator in enumerate(node.ops):
            for other in _COMPARISONS.get(type(operator), ()):
                yield _swap(node, node.ops, index, other(), f"{_SIGNS[type(operator)]} becomes {_SIGNS[other]}")
    elif isinstance(node, ast.BoolOp):
        new = ast.Or() if isinstance(node.op, ast.And) else ast.And()
        yield _set(node, "op", new, f"{_SIGNS[type(node.op)]} becomes {_SIGNS[type(new)]}")
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield _set(node, "op", None, "not is left out")
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        yield _set(node, "op", ast.UAdd(), "- becomes +")
    elif isinstance(node, ast.BinOp) and type(node.op) in _ARITHMETIC:
        new_op = _ARITHMETIC[type(node.op)]
        yield _set(node, "op", new_op(), f"{_SIGNS[type(node.op)]} becomes {_SIGNS[new_op]}")
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield _set(node, "value", not node.value, f"{node.value} becomes {not node.value}")
    elif isinstance(node, ast.Constant) and isinstance(node.value, (int, float)) and not isinstance(node.value, bool):
        other_value = 1 if node.value == 0 else 0 if isinstance(node.value, int) else 2.0 * node.value
        yield _set(node, "value", type(node.value)(other_value), f"{node.value} becomes {other_value}")
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in _OTHER_CALL:
        new_name = _OTHER_CALL[node.func.id]
        yield _set(node.func, "id", new_name, f"{node.func.id} becomes {new_name}")
    elif isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Name) and isinstance(node.ctx, ast.Load):
        yield _set(node, "slice", ast.Constant(0), f"[{node.slice.id}] becomes [0]")
    elif isinstance(node, ast.IfExp):
        yield _set(node, "test", ast.UnaryOp(ast.Not(), node.test), "the condition is turned round")


def _of_block(node: ast.AST) -> Iterator[Callable[[], tuple[int, str]]]:
    for name in ("body", "orelse", "finalbody", "handlers"):
        block = getattr(node, name, None)
        if isinstance(block, list) and block and isinstance(block[0], ast.stmt):
            yield from _of_list(block, None, block)


def _of_with(node: ast.With) -> Iterator[Callable[[], tuple[int, str]]]:
    """Leave a lock or another guard out that nothing is taken from."""
    for index, item in enumerate(node.items):
        if item.optional_vars is None:

            def leave_out(at: int = index) -> tuple[int, str]:
                told = f"with {ast.unparse(node.items[at].context_expr)} is left out"
                node.items[at].context_expr = ast.Call(
                    ast.Attribute(ast.Call(ast.Name("__import__", ast.Load()), [ast.Constant("contextlib")], []),
                                  "nullcontext", ast.Load()), [], [],
                )  # fmt: skip
                return node.lineno, told

            yield leave_out


def _of_list(
    statements: Sequence[ast.stmt], docstring: ast.stmt | None, block: list[ast.stmt]
) -> Iterator[Callable[[], tuple[int, str]]]:
    """Leave statements out of a block: an early return, a raise, a reset, a call."""
    for index, statement in enumerate(statements):
        is_words = isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)
        if statement is docstring or is_words:
            continue
        what = {
            ast.Return: "return",
            ast.Raise: "raise",
            ast.Expr: "call",
            ast.Assign: "assignment",
            ast.AugAssign: "assignment",
            ast.Continue: "continue",
            ast.Break: "break",
            ast.Delete: "del",
        }.get(type(statement))
        # Without a local variable a function fails with a NameError, which any test notices. What is left out is a
        # reset, and a local variable that is made anew from itself, as by a clamp.
        is_local = isinstance(statement, ast.Assign) and all(
            isinstance(it, (ast.Name, ast.Tuple)) and not _reads(statement.value, it) for it in statement.targets
        )
        if what is None or is_local:
            continue

        def leave_out(at: int = index, told: str = what) -> tuple[int, str]:
            line = block[at].lineno
            block[at] = ast.copy_location(ast.Pass(), block[at])
            return line, f"the {told} is left out"

        yield leave_out


def _reads(value: ast.expr, target: ast.expr) -> bool:
    """Whether a value is made from a variable that it then takes the place of."""
    read = {node.id for node in ast.walk(value) if isinstance(node, ast.Name)}
    return any(isinstance(node, ast.Name) and node.id in read for node in ast.walk(target))


def _set(node: Any, field: str, value: Any, told: str) -> Callable[[], tuple[int, str]]:
    def change() -> tuple[int, str]:
        if value is None:
            # `not x` becomes `bool(x)`: a node cannot take itself out of its parent.
            node.op = ast.Not()
            node.operand = ast.copy_location(ast.UnaryOp(ast.Not(), node.operand), node)
        else:
            setattr(node, field, value)
        return node.lineno, told

    return change


def _swap(node: ast.Compare, items: list[Any], at: int, value: Any, told: str) -> Callable[[], tuple[int, str]]:
    def change() -> tuple[int, str]:
        items[at] = value
        return node.lineno, told

    return change


def _code_of(tree: ast.Module, function: FunctionType) -> CodeType | None:
    """Compile a broken function as the whole one was: with its closure's names, so that its code can take the place."""
    free = function.__code__.co_freevars
    top = tree.body[0]
    assert isinstance(top, (ast.FunctionDef, ast.AsyncFunctionDef))
    top.decorator_list = []
    if free:
        outer = ast.parse("def outer():\n" + "".join(f"    {name} = None\n" for name in free) + "    pass")
        assert isinstance(outer.body[0], ast.FunctionDef)
        outer.body[0].body.append(top)
        tree = outer
    ast.fix_missing_locations(tree)
    flags = function.__code__.co_flags & 0x1000000  # from __future__ import annotations
    whole = compile(tree, function.__code__.co_filename, "exec", flags=flags, dont_inherit=True)
    return _find(whole, function.__name__, free)


def _find(code: CodeType, name: str, free: tuple[str, ...]) -> CodeType | None:
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            if constant.co_name == name:
                return constant if set(constant.co_freevars) == set(free) else None
            if (found := _find(constant, name, free)) is not None:
                return found
    return None
