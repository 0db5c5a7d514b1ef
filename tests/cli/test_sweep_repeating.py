"""What is called now and then while a block runs."""

import threading

import pytest
from helpers import HANG_S

from legged.sweeping.trials import repeating


@pytest.mark.parametrize("at_end", [False, True])
def test_calls_come_while_the_block_runs_and_end_with_it(at_end):
    calls, third = [], threading.Event()

    def call():
        calls.append(threading.current_thread())
        if len(calls) == 3:
            third.set()

    with repeating(call, 0.001, at_end):
        assert third.wait(HANG_S)
    assert threading.current_thread() not in calls
    assert not calls[0].is_alive()


def test_a_short_block_is_followed_by_the_last_call_alone():
    calls = []
    with repeating(lambda: calls.append(1), 100.0):
        pass
    assert calls == []
    with pytest.raises(KeyError), repeating(lambda: calls.append(1), 100.0, at_end=True):
        raise KeyError
    assert calls == [1]
