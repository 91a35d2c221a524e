"""Work that goes on in a thread beside a command."""

import contextlib
import threading

import pytest

from mcc_jax.cli._session import beside


def test_the_result_is_there_when_it_is_asked_for():
    begun, may_end = threading.Event(), threading.Event()

    def work():
        begun.set()
        assert may_end.wait(60)
        return 7

    with beside(work) as found:
        assert begun.wait(60)  # it runs while the block does
        may_end.set()
    assert found() == 7


def test_what_the_work_raises_is_raised_where_the_result_is_asked_for():
    def work():
        raise ValueError("no result")

    with beside(work) as found:
        pass
    with pytest.raises(ValueError, match="no result"):
        found()


@pytest.mark.parametrize("fails", [False, True])
def test_a_block_ends_after_the_work_whether_it_fails_or_not(fails):
    may_end, ended = threading.Event(), threading.Event()

    def work():
        assert may_end.wait(60)
        ended.set()

    def block():
        with beside(work):
            may_end.set()
            if fails:
                raise ValueError("the block")

    with pytest.raises(ValueError, match="the block") if fails else contextlib.nullcontext():
        block()
    assert ended.is_set()


def test_a_block_that_is_interrupted_does_not_wait():
    may_end = threading.Event()

    def interrupted():
        with beside(lambda: may_end.wait(60)):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert not may_end.is_set()
    may_end.set()
