"""Work done ahead by threads, in order, and never too far ahead."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from typing import TypeVar

A, B = TypeVar("A"), TypeVar("B")


def ahead(pool: Executor, work: Callable[[A], B], items: Iterable[A], most: int) -> Iterator[B]:
    """`map(work, items)` by a pool, with at most `most` items taken that were not yet given on."""
    pending = deque()
    for item in items:
        pending.append(pool.submit(work, item))
        if len(pending) >= most:
            yield pending.popleft().result()
    while pending:
        yield pending.popleft().result()
