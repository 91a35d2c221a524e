"""Public names that are gone, and what stands in their place; the table in CHANGELOG.md is the same."""

from __future__ import annotations

RENAMED = {
    "calibrate_bayes": "sample",
    "BayesCalibration": "Posterior",
    "calibrate_least_squares": "least_squares",
    "LeastSquaresCalibration": "LeastSquares",
    "JointModel": "Model",
    "HalfNormalPrior": "NakagamiPrior",
    "new_laws": "sample_laws",
    "beside_paper": "compare_with_paper",
    "ExtendedLaw": "MccLaw",
    "batch": "select_tests",
}
"""By the old name the name, of this library, that does the same."""

NOTES = {
    "ExtendedLaw": "a law with effects is law.with_effects(...)",
    "HalfNormalPrior": "NakagamiPrior(sd, shape=0.5) is the half-normal",
    "batch": "it gives the tests as padded arrays",
}
"""What else there is to know."""


class RenamedError(ImportError):
    """A name of an earlier version.

    An `ImportError`, because `from mcc_jax import name` would put a message of its own in place of an `AttributeError`.
    """

    def __init__(self, name: str) -> None:
        note = f"; {NOTES[name]}" if name in NOTES else ""
        super().__init__(
            f"mcc_jax.{name} is called mcc_jax.{RENAMED[name]} now{note}. CHANGELOG.md lists all changed names"
        )
