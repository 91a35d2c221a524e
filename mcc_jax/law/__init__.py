"""The contact law: loading, unloading, reloading, its inverse, its energy, its population."""

from ..formulas import PUNCH_AREA as PUNCH_AREA
from ..formulas import Plastic as Plastic
from ..formulas import StrainScaling as StrainScaling
from ..formulas import Unloading as Unloading
from ..formulas import energy_ratio as energy_ratio
from ..formulas import recovery as recovery
from ..formulas import stress_ratio as stress_ratio
from .derivatives import signatures as signatures
from .mcc import TESTED_STRAIN as TESTED_STRAIN
from .mcc import AbstractContactLaw as AbstractContactLaw
from .mcc import Energy as Energy
from .mcc import History as History
from .mcc import MccLaw as MccLaw
from .population import LogNormal as LogNormal
from .population import PlasticPopulation as PlasticPopulation
