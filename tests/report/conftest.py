import shutil

import pytest
from results_folder import changed, stand_in, write_results


@pytest.fixture(scope="session", autouse=True)
def _saved_calibrations_are_stand_ins():
    """What is saved in these tests is the truth and not the result of a calibration, which takes long."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mcc_jax.report.read.read_saved", stand_in)
        yield


@pytest.fixture(scope="session")
def complete(tmp_path_factory):
    """A folder with everything; do not write into it."""
    return write_results(tmp_path_factory.mktemp("complete"))


@pytest.fixture
def folder(complete, tmp_path):
    """A copy of it, to be changed."""
    return shutil.copytree(complete, tmp_path / "results")


@pytest.fixture(scope="session")
def page(complete):
    """The page of the complete folder."""
    from mcc_jax.report import read_results, report_page

    return report_page(read_results(complete, name="complete"))


@pytest.fixture
def without_posterior(folder):
    """A folder in which predictions come from estimates alone."""
    changed(folder, method="least-squares")
    return folder


@pytest.fixture(scope="session")
def results(complete):
    from mcc_jax.report import read_results

    return read_results(complete)


@pytest.fixture(scope="session")
def shown(results):
    from mcc_jax.report.chart import compare

    return compare(results)
