import shutil

import pytest
from asserting import done

PARTICLES = (
    "particle,D1_um,D2_um,D3_um,batch\nA,213.54,196.07,186.33,x\nB,155.32,217.51,136.87,y\nC,97.56,100.98,69.09,y\n"
)


@pytest.fixture(scope="session")
def simulated(run, tmp_path_factory):
    """A small campaign made by `simulate`; do not write into it."""
    folder = tmp_path_factory.mktemp("simulated")
    (folder / "three.csv").write_text(PARTICLES)
    done(run("simulate", "--particles", folder / "three.csv", "--out", folder / "campaign", "--points", "60"))
    return folder / "campaign"


@pytest.fixture
def campaign(simulated, tmp_path):
    """A copy of it, to be damaged."""
    return shutil.copytree(simulated, tmp_path / "campaign")
