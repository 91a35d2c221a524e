"""The contact law: loading, unloading, reloading, its inverse, its energy, its population, its references."""

from ._base import AbstractContactLaw as AbstractContactLaw
from ._loading_inverse import loading_strain as loading_strain
from ._loading_inverse import tangent_modulus as tangent_modulus
from ._mcc import TESTED_STRAIN as TESTED_STRAIN
from ._mcc import Energy as Energy
from ._mcc import History as History
from ._mcc import MccLaw as MccLaw
from ._plastic import Plastic as Plastic
from ._population import LogNormal as LogNormal
from ._population import PlasticPopulation as PlasticPopulation
from ._recovery import energy_ratio as energy_ratio
from ._recovery import recovery as recovery
from ._recovery import stress_ratio as stress_ratio
from ._reference import hertz_shape_factor as hertz_shape_factor
from ._reference import hertz_stress as hertz_stress
from ._reference import ideal_plastic_stress as ideal_plastic_stress
from ._reference import similarity_strength as similarity_strength
from ._reference import similarity_stress as similarity_stress
from ._unloading import PUNCH_AREA as PUNCH_AREA
from ._unloading import StrainScaling as StrainScaling
from ._unloading import Unloading as Unloading
from .recovery_limit import least_stiffness as least_stiffness
