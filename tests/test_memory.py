"""A process that calibrates many campaigns does not run into the system's limit on memory maps."""

import jax
import jax.numpy as jnp
import pytest

from mcc_jax import _memory
from mcc_jax._memory import make_room


@pytest.fixture
def traced():
    """A compiled function and how often it was traced."""
    count = []

    @jax.jit
    def function(x):
        count.append(1)
        return x + 1

    function(jnp.zeros(3))
    return function, count


def limit(monkeypatch, tmp_path, text):
    file = tmp_path / "max_map_count"
    file.write_text(text)
    monkeypatch.setattr(_memory, "MAX_MAPS", file)


@pytest.mark.skipif(not _memory.MAPS.exists(), reason="only Linux limits memory maps, and shows them")
@pytest.mark.parametrize(("most", "times"), [(10, 2), (10**9, 1)])
def test_compiled_functions_are_forgotten_near_the_limit_only(traced, monkeypatch, tmp_path, most, times):
    function, count = traced
    limit(monkeypatch, tmp_path, f"{most}\n")
    make_room()
    assert function(jnp.ones(3)).tolist() == [2, 2, 2]
    assert len(count) == times


@pytest.mark.parametrize("text", [None, "", "many"])
def test_nothing_happens_where_the_limit_is_not_known(traced, monkeypatch, tmp_path, text):
    function, count = traced
    limit(monkeypatch, tmp_path, text or "")
    if text is None:
        monkeypatch.setattr(_memory, "MAPS", tmp_path / "none")
    make_room()
    function(jnp.ones(3))
    assert len(count) == 1
