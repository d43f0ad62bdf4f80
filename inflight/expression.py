"""Small expressions over named arrays: ``good_when`` of a mission YAML, and formulas of channels.

Only comparisons, arithmetic, ``and or not & | ~``, numbers, names, ``name[column]`` and a few functions
(`FUNCTIONS`) are allowed; the text is parsed into a tree whose every node is checked, and none of it is run
as Python.
"""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[Any]

_BINARY: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.BitAnd: operator.and_,
    ast.BitOr: operator.or_,
}

_COMPARE: dict[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}

_UNARY: dict[type[ast.unaryop], Callable[[Any], Any]] = {
    ast.Not: np.logical_not,
    ast.Invert: operator.invert,
    ast.USub: operator.neg,
}

#: What may be called, by name: functions of one array.
FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    name: getattr(np, name) for name in ("abs", "sqrt", "exp", "log", "sin", "cos")
}


class Expression:
    """One expression, checked when it is made.

    Parameters
    ----------
    text : str
        For example ``"DQF == 0 and (status & 4) == 0"``.

    Raises
    ------
    ValueError
        When the text is no expression or holds anything but the operations above.
    """

    _ALLOWED: ClassVar[tuple[type[ast.AST], ...]] = (
        ast.Expression,
        ast.BoolOp,
        ast.And,
        ast.Or,
        ast.BinOp,
        ast.UnaryOp,
        ast.Compare,
        ast.Name,
        ast.Attribute,
        ast.Subscript,
        ast.Call,
        ast.Constant,
        ast.Load,
        *_BINARY,
        *_COMPARE,
        *_UNARY,
    )

    def __init__(self, text: str) -> None:
        self.text = text
        try:
            self._tree = ast.parse(text.strip(), mode="eval").body
        except (SyntaxError, ValueError, RecursionError) as error:
            raise ValueError(f"{text!r} is no expression: {error}") from None
        for node in ast.walk(self._tree):
            self._check(node)
        self.names: tuple[str, ...] = tuple(dict.fromkeys(_names(self._tree)))
        if not self.names:
            raise ValueError(f"{text!r} names no variable of the file")

    def _check(self, node: ast.AST) -> None:
        known = isinstance(node, self._ALLOWED)
        if isinstance(node, ast.Constant):
            known = isinstance(node.value, bool | int | float)
        if isinstance(node, ast.Subscript):
            known = isinstance(node.slice, ast.Constant) and isinstance(node.slice.value, int)
        if isinstance(node, ast.Attribute | ast.Subscript):
            known = known and isinstance(node.value, ast.Name | ast.Attribute)
        if isinstance(node, ast.Call):
            named = isinstance(node.func, ast.Name) and node.func.id in FUNCTIONS
            known = named and len(node.args) == 1 and not node.keywords
        if not known:
            raise ValueError(
                f"{self.text!r}: {type(node).__name__} is not allowed; use comparisons, + - * /, & | ~, "
                f"and or not, numbers, names of variables, and of one of them {', '.join(FUNCTIONS)}"
            )

    def compute(self, values: dict[str, Values]) -> npt.NDArray[np.float64]:
        """Return the value of the expression, as numbers; true is 1, false 0.

        Parameters
        ----------
        values : dict of ndarray
            As `evaluate` takes them.

        Returns
        -------
        ndarray of float
            NaN wherever a variable is NaN, comparisons too: what is not known is no number.

        Raises
        ------
        ValueError
            As `evaluate`.
        """
        found = np.array(self._value(values), dtype=np.float64)
        for one in (values[name] for name in self.names):
            missing = np.isnan(one) if one.ndim == 1 else np.isnan(one).any(axis=1)
            found[missing] = np.nan
        return found

    def evaluate(self, values: dict[str, Values]) -> npt.NDArray[np.bool_]:
        """Return where the expression is true.

        Parameters
        ----------
        values : dict of ndarray
            One array for each of `names`; their shapes must broadcast.

        Returns
        -------
        ndarray of bool
            Comparisons with NaN are false.

        Raises
        ------
        ValueError
            When the arrays cannot be combined so (text compared with numbers, bits of fractions).
        """
        return np.asarray(self._value(values)).astype(bool)

    def _value(self, values: dict[str, Values]) -> Any:
        try:
            with np.errstate(all="ignore"):
                return _evaluate(self._tree, values)
        except TypeError as error:
            raise ValueError(f"{self.text!r} cannot be computed: {error}") from None


def _names(node: ast.AST) -> list[str]:
    if isinstance(node, ast.Name | ast.Attribute):
        return [ast.unparse(node)]
    if isinstance(node, ast.Call):
        return [name for argument in node.args for name in _names(argument)]
    return [name for child in ast.iter_child_nodes(node) for name in _names(child)]


def _evaluate(node: ast.AST, values: dict[str, Values]) -> Any:
    result: Any
    if isinstance(node, ast.Constant):
        result = node.value
    elif isinstance(node, ast.Name | ast.Attribute):
        result = values[ast.unparse(node)]
    elif isinstance(node, ast.Subscript):
        result = _evaluate(node.value, values)[:, ast.literal_eval(node.slice)]
    elif isinstance(node, ast.Call):
        result = FUNCTIONS[ast.unparse(node.func)](_evaluate(node.args[0], values))
    elif isinstance(node, ast.BinOp):
        result = _BINARY[type(node.op)](_evaluate(node.left, values), _evaluate(node.right, values))
    elif isinstance(node, ast.UnaryOp):
        result = _UNARY[type(node.op)](_evaluate(node.operand, values))
    else:
        result = _truth(node, values)
    return result


def _truth(node: ast.AST, values: dict[str, Values]) -> Any:
    if isinstance(node, ast.BoolOp):
        combine = np.logical_and if isinstance(node.op, ast.And) else np.logical_or
        parts = [_evaluate(part, values) for part in node.values]
        result = parts[0]
        for part in parts[1:]:
            result = combine(result, part)
        return result
    assert isinstance(node, ast.Compare)
    sides = [_evaluate(side, values) for side in (node.left, *node.comparators)]
    result = _COMPARE[type(node.ops[0])](sides[0], sides[1])
    for kind, left, right in zip(node.ops[1:], sides[1:], sides[2:], strict=False):
        result = np.logical_and(result, _COMPARE[type(kind)](left, right))
    return result
