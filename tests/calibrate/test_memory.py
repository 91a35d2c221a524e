"""A process that calibrates many campaigns does not run into the system's limit on memory maps."""

import jax
import jax.numpy as jnp
import pytest

from mcc_jax.calibrate import compiling
from mcc_jax.calibrate.compiling import make_room


@pytest.mark.skipif(not compiling.MAPS.exists(), reason="only Linux limits memory maps, and shows them")
@pytest.mark.parametrize(("limit", "times"), [("10\n", 2), (f"{10**9}\n", 1), ("", 1), ("many", 1), (None, 1)])
def test_compiled_functions_are_forgotten_near_a_known_limit_only(monkeypatch, tmp_path, limit, times):
    traced = []

    @jax.jit
    def function(x):
        traced.append(1)
        return x + 1

    function(jnp.zeros(3))
    file = tmp_path / "max_map_count"
    if limit is None:  # no maps are shown
        monkeypatch.setattr(compiling, "MAPS", file)
    else:
        file.write_text(limit)
        monkeypatch.setattr(compiling, "MAX_MAPS", file)
    make_room()
    assert function(jnp.ones(3)).tolist() == [2, 2, 2]
    assert len(traced) == times
