"""One thread for the many small factorisations: with more, a busy machine spends its time waiting."""

import contextlib

import pytest


@pytest.fixture(scope="session", autouse=True)
def _one_thread():
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(ImportError):  # not a dependency: without it the tests are slower, not different
            from threadpoolctl import threadpool_limits

            stack.enter_context(threadpool_limits(1))
        yield
