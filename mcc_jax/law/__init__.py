"""The contact law: loading, unloading, reloading, its inverse, its energy, its population."""

from ..formulas import Formulas as Formulas
from ..formulas.plastic import Plastic as Plastic
from ..formulas.recovery import energy_ratio as energy_ratio
from ..formulas.recovery import recovery as recovery
from ..formulas.recovery import stress_ratio as stress_ratio
from ..formulas.unloading import PUNCH_AREA as PUNCH_AREA
from ..formulas.unloading import StrainScaling as StrainScaling
from ..formulas.unloading import Unloading as Unloading
from .base import AbstractContactLaw as AbstractContactLaw
from .derivatives import signatures as signatures
from .mcc import TESTED_STRAIN as TESTED_STRAIN
from .mcc import Energy as Energy
from .mcc import History as History
from .mcc import MccLaw as MccLaw
from .population import LogNormal as LogNormal
from .population import PlasticPopulation as PlasticPopulation
