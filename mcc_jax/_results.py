"""Why a computation ended: readable reasons instead of codes."""

from __future__ import annotations

import optimistix as optx


class RESULTS(optx.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]  # an Enumeration of Equinox, no enum
    """Results of the entry points, next to those of Optimistix."""

    successful = ""
    nonfinite_response = (
        "The law returned a number that is not finite. "
        "Every diameter must be positive and every entry of the path finite."
    )
    bad_parameter = (
        "A parameter of the law is out of range: C1, C5 and the effective modulus must be positive, C3 not negative."
    )
    no_stress = (
        "The shape factor 1 + a (1 - D3^2/(D1 D2)) is not positive, so the particle carries no stress. "
        "Take a larger (less negative) a."
    )
