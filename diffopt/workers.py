"""Work of several threads, in order."""

import collections
import os
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

import jax

# More threads wait for the interpreter, and for each other's arithmetic.
_MOST = 4

Item, Result = TypeVar("Item"), TypeVar("Result")


def count() -> int:
    """Threads that pay on this machine."""
    allowed = getattr(os, "sched_getaffinity", None)
    return min(len(allowed(0)) if allowed else os.cpu_count() or 1, _MOST)


def ahead(
    work: Callable[[Item], Result], items: Sequence[Item], workers: int
) -> Generator[Result, None, None]:
    """Results of items in their order, while threads work on the next ones.

    Parameters
    ----------
    work
        Made of one item; at most `workers` + 1 results are held.
    items
        In order.
    workers
        Threads; with 1, nothing is done before it is asked for.

    What `work` raises is raised here. Closed early, it waits for what has begun.
    """
    if workers == 1 or len(items) < 2:
        yield from map(work, items)
        return
    # JAX keeps these for each thread.
    config: Any = jax.config
    wide, device = config.jax_enable_x64, config.jax_default_device

    def one(item: Item) -> Result:
        with jax.enable_x64(wide), jax.default_device(device):
            return work(item)

    pool = ThreadPoolExecutor(workers)
    begun: collections.deque[Future[Result]] = collections.deque()
    try:
        for item in items:
            begun.append(pool.submit(one, item))
            if len(begun) > workers:
                yield begun.popleft().result()
        while begun:
            yield begun.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
