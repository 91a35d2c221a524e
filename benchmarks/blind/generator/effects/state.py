"""What several formulas ask of a sample: size of its contact, whether it is on the elastic branch."""

from __future__ import annotations

import numpy as np

from ..law import CONTACT_AREA
from .form import Array, State


def contact_radius(eps: Array, Re: Array | float) -> Array:
    """Radius of the contact in um, each plate taking half of the approach: sqrt(2 c2 R h), h = D_e eps / 2."""
    return Re * np.sqrt(2.0 * CONTACT_AREA * np.maximum(eps, 0.0))


def below(s: State) -> Array:
    """Whether a sample is on the elastic branch."""
    return s.u < 1.0
