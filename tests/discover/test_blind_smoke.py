"""Some of the blind bench's fixed cases, whose generator shares no code with the library; all forty as a long study.

The study: `pytest -m study tests/discover/test_blind_smoke.py -n 2`.
"""

import pytest

from benchmarks.blind import adapter, smoke
from benchmarks.blind.generator import campaigns

pytestmark = pytest.mark.long  # compiles for long

CASES = {case.id: case for case in smoke.cases()}
FEW = (
    pytest.param("T0-clean-1", marks=pytest.mark.long),
    pytest.param("T1-reverse_plasticity.exact-20-P1-0", marks=pytest.mark.long),
    pytest.param("T4-mid_unloading_bump.unlisted-20-P1-1", marks=pytest.mark.long),
)
"""A null, an exact formula among close relatives, one unlisted: all of one shape, so that they compile once."""


def answer(case, folder, **options):
    campaigns.write(campaigns.build(case, smoke.MASTER_SEED), folder / "campaign")
    return adapter.in_process(folder / "campaign", exclude=case.exclude, options={**case.solver_options, **options})


@pytest.mark.parametrize("name", FEW)
def test_some_blind_cases_get_their_verdict(name, tmp_path):
    told = answer(CASES[name], tmp_path, confirm=False, experiments=False, posterior=False)
    assert adapter.problem(told) is None
    assert smoke.check(CASES[name], told) is None


@pytest.mark.study
@pytest.mark.parametrize("name", CASES)
def test_every_blind_case_gets_its_verdict(name, tmp_path):
    told = answer(CASES[name], tmp_path)
    assert adapter.problem(told) is None
    assert smoke.check(CASES[name], told) is None
