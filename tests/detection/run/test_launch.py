"""Launches on several cores of the CPU."""

import os
import threading

import numpy as np
import pytest
import warp as wp

from warp_bsc.bench.timing import limited_threads
from warp_bsc.detection.run import launch
from warp_bsc.detection.run.launch import cores, count_cores, launch_on_cores, launch_over, thread_pool
from warp_bsc.implicit.contact.team import lower_int_to
from warp_bsc.kernels.pipeline.queues import take_slot_int


@wp.kernel
def add_one(first: int, values: wp.array[int]):
    i = first + wp.tid()
    wp.atomic_add(values, i, 1)


@wp.kernel
def take_number(taken: wp.array[int], values: wp.array[int], least: wp.array[int]):
    number = take_slot_int(taken)
    values[number] = values[number] + 1
    lower_int_to(least, number % 3, -number)


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("count", [0, 1, 5, 64, 100_001])
def test_every_number_is_taken_once(threads, count):
    taken, least, values = (wp.zeros(max(n, 1), dtype=int, device="cpu") for n in (1, 3, count))
    with cores(threads):
        launch_on_cores(take_number, count, inputs=[taken, values, least], device=values.device)
    assert taken.numpy()[0] == count and np.array_equal(values.numpy()[:count], np.ones(count))
    if count > 3:
        assert sorted(least.numpy()) == [1 - count, 2 - count, 3 - count]


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("count", [0, 1, 63, 64, 65, 1000, 100_001])
def test_every_entry_is_reached_once(threads, count):
    values = wp.zeros(max(1, count), dtype=int, device="cpu")
    with cores(threads):
        launch_over(add_one, count, inputs=[], outputs=[values], device=values.device, chunk=64)
    assert np.array_equal(values.numpy()[:count], np.ones(count))


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity") or count_cores() < 2, reason="cores cannot be limited")
def test_a_launch_takes_the_cores_that_its_process_may_use(monkeypatch):
    sizes = []
    monkeypatch.setattr(launch, "thread_pool", lambda threads: sizes.append(threads) or thread_pool(threads))
    values = wp.zeros(10_000, dtype=int, device="cpu")
    for count in (1, 2):
        with limited_threads(count):
            launch_over(add_one, len(values), inputs=[], outputs=[values], device=values.device, chunk=64)
    assert sizes == [2] and (values.numpy() == 2).all()


def test_a_launch_does_not_wait_for_threads_that_are_busy():
    free = threading.Event()
    waiting = threading.Timer(20.0, free.set)
    waiting.start()
    busy = [thread_pool(2).submit(free.wait) for _ in range(2)]
    values = wp.zeros(10_000, dtype=int, device="cpu")
    with cores(2):
        launch_over(add_one, len(values), inputs=[], outputs=[values], device=values.device, chunk=64)
    assert values.numpy().all() and not free.is_set()
    free.set()
    waiting.cancel()
    assert all(thread.result() for thread in busy)
