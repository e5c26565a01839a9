"""map_items: the same results in the same order, in this process and in others."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field
from functools import cached_property

import pytest

from georef.executor import Executor


@dataclass
class Slow:
    """A task whose first items take longest; it keeps what it built in its process."""

    offset: int

    @cached_property
    def built_in(self) -> int:
        return os.getpid()

    def __call__(self, item: int) -> tuple[int, int, bool]:
        time.sleep(0.05 if item < 2 else 0.0)
        return item + self.offset, self.built_in, self.built_in == os.getpid()


def fail_at_two(item: int) -> int:
    if item == 2:
        raise ValueError("a fault of our own")
    return item


@dataclass
class Counting:
    """A progress that counts."""

    seen: list[object] = field(default_factory=list)

    def begin(self, label: str, total: int) -> None:
        self.seen += [label, total]

    def advance(self, done: int = 1) -> None:
        self.seen.append(done)

    def end(self) -> None:
        self.seen.append("end")


def test_results_come_in_order_and_from_other_processes() -> None:
    items = list(range(7))
    here = list(Executor().map_items(Slow(10), items, "here"))
    there = list(Executor(workers=2, threads=1).map_items(Slow(10), items, "there"))
    assert [result[0] for result in here] == [result[0] for result in there] == [item + 10 for item in items]
    assert {result[1] for result in here} == {os.getpid()}
    assert os.getpid() not in {result[1] for result in there}
    assert len({result[1] for result in there}) <= 2
    assert all(result[2] for result in there)


def test_nothing_to_do_starts_nothing() -> None:
    progress = Counting()
    assert list(Executor(workers=4, progress=progress).map_items(Slow(0), [], "none")) == []
    assert progress.seen == ["none", 0, "end"]


def test_progress_is_shown_as_results_are_taken() -> None:
    progress = Counting()
    results = Executor(progress=progress).map_items(fail_at_two, [0, 1], "some")
    next(results)
    assert progress.seen == ["some", 2, 1]
    assert list(results) == [1]
    assert progress.seen == ["some", 2, 1, 1, "end"]


@pytest.mark.parametrize("workers", [1, 2])
def test_a_fault_of_our_own_is_raised_after_the_results_before_it(workers: int) -> None:
    progress = Counting()
    results = Executor(workers=workers, threads=1, progress=progress).map_items(fail_at_two, [0, 1, 2, 3], "fault")
    taken = []
    with pytest.raises(ValueError, match="a fault of our own"):
        taken.extend(results)
    assert taken == [0, 1]
    assert progress.seen[-1] == "end"


@dataclass
class Kept:
    """Something that stays where it was made, and counts how often it was asked."""

    value: int
    asked: int = 0

    def add(self, number: int) -> tuple[int, int, int]:
        self.asked += 1
        return self.value + number, self.asked, os.getpid()


@pytest.mark.parametrize("workers", [1, 2])
def test_what_is_held_keeps_its_state_between_calls(workers: int) -> None:
    with Executor(workers=workers).held() as held:
        held.put(Kept, iter([10, 20, 30]))
        first = held.call(Kept.add, [1, 2, 3])
        second = held.call(Kept.add, [4, 5, 6])
        assert [result[:2] for result in first] == [(11, 1), (22, 1), (33, 1)]
        assert [result[:2] for result in second] == [(14, 2), (25, 2), (36, 2)]
        assert [result[2] for result in first] == [result[2] for result in second]
        assert len({result[2] for result in first}) == workers
        assert (os.getpid() in {result[2] for result in first}) == (workers == 1)
        held.put(Kept, [7])
        assert held.call(Kept.add, [1])[0][:2] == (8, 1)
