"""The paper's own numbers: Table 1 (diameters), Table 2 (plastic coefficients), a and the effective modulus."""

import numpy as np

PAPER_DIAMETERS_UM = np.array(
    [
        (213.54, 196.07, 186.33),
        (155.32, 217.51, 136.87),
        (168.74, 171.64, 125.15),
        (97.56, 100.98, 69.09),
        (238.47, 249.24, 237.81),
        (93.8, 76.46, 52.85),
        (160.44, 167.7, 151.3),
        (114.1, 114.54, 80.98),
        (168.31, 144.54, 131.27),
        (133.8, 117.12, 103.38),
        (122.69, 131.73, 109.91),
        (121.04, 205.93, 133.08),
        (185.1, 206.98, 146.91),
        (180.35, 173.88, 139.81),
        (173.26, 157.3, 147.79),
        (296.34, 267.76, 219.78),
        (219.5, 281.94, 225.55),
        (194.97, 167.95, 151.23),
        (105.57, 109.25, 86.46),
        (154.12, 182.82, 166.13),
    ]
)
"""D1, D2, D3 [um] of the 20 Avicel PH-200 particles, in the paper's order (Bommireddy et al. 2018, Table 1)."""
PAPER_DIAMETERS_UM.setflags(write=False)

PAPER_LOG_C = {"C1": (1.9027, 0.2985), "C3": (1.1015, 4.8914e-9), "C5": (0.9784, 0.0797)}
"""Mean and standard deviation of log C (Bommireddy et al. 2018, Table 2).

The spread of C3 is no measurement: a fit of the variance of the master curve ends at its lower bound, zero.
"""

PAPER_SHAPE_PARAMETER = 1.43
"""a of the shape factor (Bommireddy et al. 2018, section 4)."""

PAPER_EFFECTIVE_MODULUS_MPA = 16_000.0
"""Effective modulus [MPa]; it belongs to the printed unloading form only (Bommireddy et al. 2018, section 6)."""
