import os
import pathlib
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


# What compiles the same things runs on one worker, one after the other, and shares the folder above.
TOGETHER = {
    "discover": ("discover/", "cli/test_discover.py", "plots/test_discovery_figures.py", "[05_discovery]"),
    "joint": ("calibrate/joint/", "plots/test_joint_figures.py", "cli/test_commands.py", "[04_posterior]"),
}


def pytest_collection_modifyitems(items):
    """Each file is one group, the long ones together and first."""

    order = {name: i for i, name in enumerate(TOGETHER)}
    items.sort(key=lambda item: order.get(group_of(item.nodeid), len(order)))
    for item in items:
        item.add_marker(pytest.mark.xdist_group(group_of(item.nodeid)))


def group_of(place):
    """Name of the group of a test or file."""
    return next((name for name, parts in TOGETHER.items() if any(p in place for p in parts)), place.split("::")[0])


MOST_MAPS = 30_000
_current = [""]


@pytest.fixture(scope="module", autouse=True)
def _compiled_functions_live_for_one_group(request):
    """Every compiled function holds memory maps, of which Linux gives a process 65,530 and no more."""
    group = group_of(request.node.nodeid)
    maps = pathlib.Path("/proc/self/maps")
    if group != _current[0] or not maps.exists() or len(maps.read_bytes().splitlines()) > MOST_MAPS:
        jax.clear_caches()
    _current[0] = group


@pytest.fixture(scope="session")
def paper_posterior():
    """The default posterior of the simulated campaign from the paper's tables."""
    from mcc_jax import calibrate_bayes, paper_campaign  # not before its annotations are checked

    return calibrate_bayes(paper_campaign(0))
