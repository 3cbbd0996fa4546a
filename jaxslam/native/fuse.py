"""Products of matrices among operations: those written as sums, and what is added to one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from jaxslam.native.elements import CODES, Refs
from jaxslam.native.program import Apply, Loop, Product, While

MANY = 64
"""Sums of products from which on they are looked at as a product of matrices."""
FILLED = 1.3
"""Of a block at most so many times what is wanted."""
Terms = list[tuple[int, list[int]]]
"""Sign, and leaves of a form of which the product is meant: one or two."""


def fused(plan: Any, uses: np.ndarray) -> list[Any]:
    """The steps of a `Plan` with such operations as `Product`; `uses` counts them by element."""
    return _steps(plan, uses, plan.program.steps)


def _steps(plan: Any, uses: np.ndarray, steps: list[Any]) -> list[Any]:
    owner = np.full(plan.live.size, -1)
    result: list[Any] = []
    for step in steps:
        match step:
            case Loop():
                step = replace(step, steps=_steps(plan, uses, step.steps))
            case While():
                inner = (_steps(plan, uses, x) for x in (step.condition, step.steps))
                step = replace(step, **dict(zip(("condition", "steps"), inner, strict=True)))
            case Product():
                owner[step.made] = len(result)
            case Apply():
                step = _apply(plan, uses, step, owner, result)
        result.append(step)
    return [step for step in result if step is not None]


def _apply(plan: Any, uses, step: Apply, owner, result: list[Any]) -> Apply:
    """Append fused products to the result, and return the step without what they replace."""
    made = step.made[plan.live[step.made] & ~plan.inlined[step.made]]
    gone = []
    for form in np.unique(plan.form[made]).tolist():
        refs = made[plan.form[made] == form]
        terms = _terms(plan, form)
        if terms is None or refs.size < MANY:
            continue
        sources = plan.leaves(refs)
        products = _with_addend(plan, uses, refs, terms, sources, owner, result)
        if products is None and all(len(x) == 2 and sign == 1 for sign, x in terms):
            products = _factors(refs, terms, sources)
        if products is not None:
            result.extend(products)
            gone.append(refs)
    return Apply(np.setdiff1d(step.made, np.concatenate(gone))) if gone else step


def _terms(plan: Any, form: int) -> Terms | None:
    """Return the terms of a sum of numbers and of products of two, else None."""
    names = {CODES[name]: name for name in ("add", "sub", "mul", "neg")}

    def visit(operand: int, leaf: int) -> tuple[Terms | None, int]:
        if operand == 0:
            return [(1, [leaf])], leaf + 1
        code, *operands = plan.forms[operand - 1]
        if code not in names:
            return None, leaf
        first, leaf = visit(operands[0], leaf)
        if names[code] == "neg":
            return _signed(first, -1), leaf
        second, leaf = visit(operands[1], leaf)
        if first is None or second is None:
            return None, leaf
        if names[code] == "mul":
            if len(first) > 1 or len(second) > 1 or len(first[0][1] + second[0][1]) > 2:
                return None, leaf
            return [(first[0][0] * second[0][0], first[0][1] + second[0][1])], leaf
        return first + _signed(second, 1 if names[code] == "add" else -1), leaf

    return visit(form + 1, 0)[0]


def _signed(terms: Terms | None, sign: int) -> Any:
    return None if terms is None else [(sign * s, x) for s, x in terms]


def _with_addend(plan, uses, refs, terms, sources, owner, result) -> list[Product] | None:
    """`c ± A Bᵀ`, where the product is used for nothing else."""
    if len(terms) != 2 or any(len(leaf) != 1 for _, leaf in terms):
        return None
    for (sign, (of,)), (sign_other, (other,)) in (terms, terms[::-1]):
        number = owner[sources[of]]
        if sign_other != 1 or number[0] < 0 or np.any(number != number[0]):
            continue
        product = result[number[0]]
        if product.addend is not None or np.any(uses[sources[of]] != 1):
            continue
        if plan.live[product.made].sum() != refs.size:
            continue
        made, addend = (np.full(product.made.shape, -1) for _ in range(2))
        where = np.isin(product.made, sources[of])
        order = np.argsort(sources[of])
        position = order[np.searchsorted(sources[of][order], product.made[where])]
        made[where], addend[where] = refs[position], sources[other][position]
        result[number[0]] = None
        return [Product(made, product.left, product.right, addend, sign)]
    return None


def _factors(refs: Refs, terms: Terms, sources: list[Refs]) -> list[Product] | None:
    """Rows and columns of sums of products: blocks in which every row meets every column."""
    first, second = (np.stack([sources[x[k]] for _, x in terms], 1) for k in (0, 1))
    swap = [len(np.unique(a)) > len(np.unique(b)) for a, b in zip(first.T, second.T, strict=True)]
    first, second = np.where(swap, second, first), np.where(swap, first, second)
    rows, row = np.unique(first, axis=0, return_inverse=True)
    columns, column = np.unique(second, axis=0, return_inverse=True)
    row, column = row.ravel(), column.ravel()
    part = _parts(row, column)
    blocks = [np.flatnonzero(part == k) for k in np.unique(part)]
    grids = [[np.unique(x[block]) for x in (row, column)] for block in blocks]
    if sum(len(a) * len(b) for a, b in grids) > FILLED * refs.size or len(blocks) * 2 > len(rows):
        return None
    products = []
    for block, (own, across) in zip(blocks, grids, strict=True):
        made = np.full((len(own), len(across)), -1)
        made[np.searchsorted(own, row[block]), np.searchsorted(across, column[block])] = refs[block]
        products.append(Product(made, rows[own], columns[across]))
    return products


def _parts(row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Number the connected components of pairs of a row and a column."""
    part = np.arange(row.size)
    while True:
        before = part
        for where in (row, column):
            least = np.full(where.max() + 1, row.size)
            np.minimum.at(least, where, part)
            part = least[where]
        if np.array_equal(part, before):
            return part
