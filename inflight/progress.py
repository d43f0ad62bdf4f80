"""How far long work is: told to whoever asked for it, stage by stage.

A stage tells how many of its steps are done and how many there are; where that is not known before, how many
there are at least.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TypeVar

#: Called with (stage, done, total) while work goes on.
Progress = Callable[[str, int, int], None]

_Result = TypeVar("_Result")
_Item = TypeVar("_Item")


def silent(stage: str, done: int, total: int) -> None:
    """Tell nobody: the progress of work that nobody watches."""


def tell_each(progress: Progress, stage: str, items: Sequence[_Item]) -> Iterator[_Item]:
    """Yield items to work on, telling before each one how many are done, and at the end that all are."""
    for done, item in enumerate(items):
        progress(stage, done, len(items))
        yield item
    if len(items):
        progress(stage, len(items), len(items))


def with_progress(
    progress: Progress, stage: str, results: Iterable[_Result], total: int
) -> Iterator[_Result]:
    """Yield results, telling after each one how many of `total` are done; of none nothing is told."""
    if total:
        progress(stage, 0, total)
    for done, result in enumerate(results, start=1):
        progress(stage, done, total)
        yield result
