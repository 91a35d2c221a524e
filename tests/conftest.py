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


@pytest.fixture(scope="module", autouse=True)
def _compiled_functions_live_for_one_module():
    yield
    jax.clear_caches()
