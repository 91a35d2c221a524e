import os
import shutil
import tempfile

import hypothesis
import jax
import pytest

# The tests are strict and in double precision; the library itself never touches these settings.
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# The same examples in every run, and no data base written into the tree.
hypothesis.settings.register_profile("repository", database=None, derandomize=True, deadline=None)
hypothesis.settings.load_profile("repository")


def pytest_configure(config):
    """What took long to compile is kept for later modules, notebooks and commands, until this run of pytest ends.

    Every worker has a folder of its own: JAX writes entries in place, and another process might read half of one.
    """
    folder = tempfile.mkdtemp(prefix="compiled-")
    config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))
    settings = {"jax_compilation_cache_dir": folder, "jax_persistent_cache_min_compile_time_secs": 0.1}
    for name, value in settings.items():
        jax.config.update(name, value)
        os.environ[name.upper()] = str(value)  # for processes that tests start


def pytest_collection_modifyitems(items):
    """The longest files first: begun last, they would keep one worker busy while the other waits."""
    first = ("/discover/", "/joint/", "/cli/", "/plots/")
    items.sort(key=lambda item: next((i for i, part in enumerate(first) if part in item.nodeid), len(first)))


@pytest.fixture(scope="module", autouse=True)
def _compiled_functions_live_for_one_module():
    yield
    jax.clear_caches()


@pytest.fixture(scope="session")
def paper_posterior():
    """The default posterior of the simulated campaign from the paper's tables."""
    from mcc_jax import calibrate_bayes, paper_campaign  # not before its annotations are checked

    return calibrate_bayes(paper_campaign(0))
