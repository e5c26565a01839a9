"""Runs one pure function over many items: in this process, or in local worker processes; same results, same order."""

from __future__ import annotations

import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


class Progress(Protocol):
    """What the command line shows while a stage works."""

    def begin(self, label: str, total: int) -> None: ...
    def advance(self, done: int = 1) -> None: ...
    def end(self) -> None: ...


class Silent:
    """Shows nothing: the progress of library calls and tests."""

    def begin(self, label: str, total: int) -> None: ...
    def advance(self, done: int = 1) -> None: ...
    def end(self) -> None: ...


@dataclass
class Executor:
    """workers = 1 runs in this process; more start fresh processes, to which `task` and its items are sent.

    A task is called with one item and returns its result; it must not fail for a bad item but return that as a
    value. It is sent once to each worker; what it needs beside (models, open stores) it builds there and keeps.
    """

    workers: int = 1
    threads: int = 0  # of each worker for linear algebra and networks; 0: all cores shared among the workers
    progress: Progress = field(default_factory=Silent)

    def map_items(self, task: Callable[[Item], Result], items: Sequence[Item], label: str) -> Iterator[Result]:
        """Results in the order of the items, each as soon as it and those before it are there."""
        self.progress.begin(label, len(items))
        try:
            for result in self._results(task, items):
                self.progress.advance()
                yield result
        finally:
            self.progress.end()

    def _results(self, task: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[Result]:
        threads = self.threads or max(1, (os.cpu_count() or 1) // self.workers)
        if self.workers == 1 or len(items) < 2:
            if self.threads:
                limit_threads(threads)
            yield from map(task, items)
            return
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(self.workers, mp_context=context, initializer=_start, initargs=(threads, task))
        try:
            # Two items in flight a worker: memory stays bounded however many items there are.
            pending: deque[Future[Any]] = deque()
            for item in items:
                pending.append(pool.submit(_work, item))
                if len(pending) > 2 * self.workers:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)

    @contextmanager
    def held(self) -> Iterator[Held]:
        """Processes that keep what is made in them between calls, as many as there are workers."""
        if self.workers == 1:
            yield Held(())
            return
        context, threads = multiprocessing.get_context("spawn"), str(self.threads or 1)
        pools = tuple(ProcessPoolExecutor(1, context, _begin, (threads,)) for _ in range(self.workers))
        try:
            yield Held(pools)
        finally:
            for pool in pools:
                pool.shutdown(cancel_futures=True)


@dataclass
class Held:
    """Objects that stay where they were made, each in one of several processes, or in this one where there are none.

    An object is made from an item that is sent once; calls on it then carry their arguments and results alone.
    """

    _pools: tuple[ProcessPoolExecutor, ...]
    _here: dict[int, Any] = field(default_factory=dict)
    _count: int = 0

    def put(self, make: Callable[[Item], Any], items: Iterable[Item]) -> None:
        """Makes an object of each item, in place of those that were there. One item at a time is on its way."""
        self._here.clear()
        for pool in self._pools:
            pool.submit(_forget).result()
        self._count = 0
        for index, item in enumerate(items):
            self._count += 1
            if self._pools:
                self._pool(index).submit(_make, index, make, item).result()
            else:
                self._here[index] = make(item)

    def call(self, function: Callable[[Any, Item], Result], arguments: Sequence[Item]) -> list[Result]:
        """Calls a function with each object and its argument, all at once; results in the order of the items."""
        assert len(arguments) == self._count
        if not self._pools:
            return [function(self._here[index], argument) for index, argument in enumerate(arguments)]
        calls = [self._pool(i).submit(_call, i, function, argument) for i, argument in enumerate(arguments)]
        return [call.result() for call in calls]

    def _pool(self, index: int) -> ProcessPoolExecutor:
        return self._pools[index % len(self._pools)]


_held: dict[int, Any] = {}  # of a worker process


def _begin(threads: str) -> None:
    """Before anything numerical is loaded, which reads these once."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = threads


def _forget() -> None:
    _held.clear()


def _make(index: int, make: Callable[[Any], Any], item: Any) -> None:
    _held[index] = make(item)


def _call(index: int, function: Callable[[Any, Any], Any], argument: Any) -> Any:
    return function(_held[index], argument)


_task: Callable[[Any], Any] | None = None  # of a worker process


def _start(threads: int, task: Callable[[Any], Any]) -> None:
    global _task
    _task = task
    limit_threads(threads)


def _work(item: Any) -> Any:
    assert _task is not None
    return _task(item)


def limit_threads(threads: int) -> None:
    """Keeps a process to a number of threads for OpenCV and torch."""
    import cv2
    import torch

    cv2.setNumThreads(threads)
    torch.set_num_threads(threads)
