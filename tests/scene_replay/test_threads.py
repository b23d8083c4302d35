"""Reading and calling ahead, and writing behind: order, number of items, errors at their turn."""

import contextvars
import threading

import pytest

from warp_bsc.scene_replay.threads import WriteBehind, map_ahead, read_ahead


def test_the_next_item_is_made_meanwhile_and_no_more():
    made = [threading.Event() for _ in range(4)]

    def items():
        for number, event in enumerate(made):
            event.set()
            yield number

    ahead = read_ahead(items())
    assert next(ahead) == 0
    assert made[1].wait(10) and not made[2].is_set()
    assert list(ahead) == [1, 2, 3]


def test_an_error_comes_when_it_is_that_items_turn():
    def items():
        yield 0
        raise ValueError("broken")

    ahead = read_ahead(items())
    assert next(ahead) == 0
    with pytest.raises(ValueError, match="broken"):
        next(ahead)
    assert list(read_ahead([])) == []


def test_items_are_made_in_the_context_of_their_reader():
    """Launches of a detection in another thread keep to the cores that are given to this one."""
    variable = contextvars.ContextVar("variable", default=0)
    variable.set(7)

    def items():
        for _ in range(2):
            yield variable.get()

    assert list(read_ahead(read_ahead(items()))) == [7, 7]


def test_calls_run_at_the_same_time_and_come_in_order():
    both = threading.Barrier(2)

    def call(item):
        both.wait(10)  # each of two calls waits for the other
        return item, threading.current_thread() is threading.main_thread()

    assert list(map_ahead(call, range(4), 2)) == [(item, False) for item in range(4)]
    assert list(map_ahead(call, [], 2)) == []


@pytest.mark.parametrize("broken", ["item", "call"])
def test_an_error_of_a_call_comes_after_the_results_before_it(broken):
    def items():
        yield 2
        yield 1
        if broken == "item":
            raise ZeroDivisionError
        yield 0

    ahead = map_ahead(lambda item: 4 // item, items(), 4)
    assert [next(ahead), next(ahead)] == [2, 4]
    with pytest.raises(ZeroDivisionError):
        next(ahead)


def test_items_are_written_in_order_in_another_thread():
    written, threads = [], set()

    def write(item):
        threads.add(threading.current_thread())
        written.append(item)

    behind = WriteBehind(write)
    for number in range(40):
        behind.put(number)
        assert len(written) >= number - 16  # at most so many wait
    behind.wait()
    behind.close()
    assert written == list(range(40)) and threads.isdisjoint({threading.main_thread()}) and len(threads) == 1


def test_an_error_in_writing_is_raised_once_and_nothing_is_written_after_it():
    written, go_on = [], threading.Event()

    def write(item):
        go_on.wait(10)
        written.append(1 // item)

    behind = WriteBehind(write)
    for item in (1, 0, 1):
        behind.put(item)
    go_on.set()
    with pytest.raises(ZeroDivisionError):
        behind.wait()
    behind.wait()
    behind.close()
    assert written == [1]
