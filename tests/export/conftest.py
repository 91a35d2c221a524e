import pytest
from calibrations import stand_in


@pytest.fixture(scope="session", autouse=True)
def _saved_calibrations_are_stand_ins():
    """What is saved in these tests is made up and not the result of a calibration, which takes long."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mcc_jax.export.origin.load", stand_in)
        yield
