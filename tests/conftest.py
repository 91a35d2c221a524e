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
    """What is compiled is kept for later modules, notebooks and commands, until this run ends, or in the folder given.

    All workers share one folder, limited in size, since JAX locks only such a folder while it writes.
    """
    _keep_everything()
    if hasattr(config, "workerinput"):
        return  # set by what the environment says
    folder = os.environ.get("JAX_COMPILATION_CACHE_DIR")  # of several runs that share what they compile, as in CI
    if folder is None:
        folder = tempfile.mkdtemp(prefix="compiled-")
        config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))
    settings = {
        "jax_compilation_cache_dir": folder,
        "jax_compilation_cache_max_size": 8 * 2**30,
        "jax_persistent_cache_min_compile_time_secs": 0.03,
    }
    for name, value in settings.items():
        jax.config.update(name, value)
        os.environ[name.upper()] = str(value)  # for workers and for processes that tests start
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the workers are as many as the cores


def _keep_everything():
    """With a limited size JAX reads the age of every file before it adds one, which takes longer than compiling."""
    try:
        from jax._src.lru_cache import LRUCache
    except ImportError:  # not public: with another version of JAX the tests may take longer
        return
    LRUCache._evict_if_needed = lambda self, **_: None


GROUPS = {
    "discover": ("tests/discovery/", "tests/cli/test_discover"),
    "posterior": (
        *("tests/calibrate/test_posterior", "tests/calibrate/test_arviz_functions", "tests/calibrate/test_importance"),
        *("tests/plots/test_joint_figures", "tests/plots/test_figures", "tests/test_repr", "tests/test_saved_results"),
    ),
    "calibrate": ("tests/calibrate/",),
    "effects": ("tests/effects/",),
    "law": ("tests/law/",),
    "dem": ("tests/dem/",),
}
"""Files that run on one worker, one after the other, since they compile the same functions; others by file."""

FIRST = ("discover", "calibrate", "posterior", "tests/cli/", "tests/plots/")
"""The longest first: begun last, they would keep one worker busy while the other waits."""


def group_of(nodeid):
    file = nodeid.split("::")[0]
    return next((group for group, starts in GROUPS.items() if file.startswith(starts)), file)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """With `--dist loadfile`, a group is what a file is otherwise."""
    from xdist.scheduler import LoadFileScheduling

    class ByGroup(LoadFileScheduling):
        def _split_scope(self, nodeid):
            return group_of(nodeid)

    return ByGroup(config, log) if config.getoption("dist") == "loadfile" else None


EVERY_CASE = (
    *("tests/campaign/test_csv.", "tests/campaign/test_folder", "tests/campaign/test_mapping"),
    *("tests/campaign/test_marks", "tests/campaign/test_readers", "tests/campaign/test_valid"),
    *("tests/cli/test_bad_input.py", "tests/report/test_report_command.py", "tests/export/test_export_command.py"),
    *("tests/simulate/test_programme.py", "tests/calibrate/test_priors.py", "tests/test_readme.py"),
)
"""Readers and errors: each case is another one, and takes milliseconds."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """The core has the first case of a test with several cases. Tests of one group are together, the longest first."""
    seen = set()
    for item in items:
        test = item.nodeid.split("[")[0]
        if item.get_closest_marker("extended") or item.nodeid.startswith(EVERY_CASE):
            continue
        if test in seen:
            item.add_marker(pytest.mark.extended)
        seen.add(test)

    def place(item):
        group = group_of(item.nodeid)
        first = next((i for i, start in enumerate(FIRST) if group.startswith(start)), len(FIRST))
        return first, list(GROUPS).index(group) if group in GROUPS else len(GROUPS)

    items.sort(key=place)


_latest_group = None


@pytest.fixture(scope="module", autouse=True)
def _compiled_functions_live_for_one_group(request):
    global _latest_group
    group = group_of(request.node.nodeid)
    if group != _latest_group:
        jax.clear_caches()
    _latest_group = group


@pytest.fixture(scope="session", autouse=True)
def _commands_are_quiet():
    """How long a command takes depends on the machine; `tests/cli/test_session.py` tests their progress."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mcc_jax.cli.session.QUIET_S", 1e6)
        yield


@pytest.fixture(scope="session")
def run():
    """The command line, in this process: `run("calibrate", folder, "--out", out)`."""
    from click.testing import CliRunner

    from mcc_jax.cli.main import cli  # not before its annotations are checked

    return lambda *arguments: CliRunner().invoke(cli, [str(a) for a in arguments], prog_name="mcc-jax")


@pytest.fixture(scope="session")
def paper_posterior():
    """The default posterior of the simulated campaign from the paper's tables."""
    from mcc_jax import paper_campaign, sample

    return sample(paper_campaign(0))
