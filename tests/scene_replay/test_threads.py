"""Reading ahead and writing behind: order, one item each, errors at their turn."""

import contextvars
import threading

import pytest

from warp_bsc.scene_replay.threads import WriteBehind, read_ahead


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


def test_items_are_written_in_order_in_another_thread():
    written, threads = [], set()

    def write(item):
        threads.add(threading.current_thread())
        written.append(item)

    behind = WriteBehind(write)
    for number in range(20):
        behind.put(number)
        assert len(written) >= number  # at most one waits
    behind.wait()
    behind.close()
    assert written == list(range(20)) and threads.isdisjoint({threading.main_thread()}) and len(threads) == 1


def test_an_error_in_writing_is_raised_once():
    behind = WriteBehind(lambda item: 1 // item)
    behind.put(0)
    with pytest.raises(ZeroDivisionError):
        behind.put(1)
    behind.wait()
    behind.close()
