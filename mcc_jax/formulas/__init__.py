"""The closed formulas below effects and law: loading, unloading, their inverses, stored energy; no memory."""

from .contact import Contact as Contact
from .contact import stored as stored
from .loading_inverse import loading_strain as loading_strain
from .loading_inverse import secant_modulus as secant_modulus
from .loading_inverse import tangent_modulus as tangent_modulus
from .parameters import Formulas as Formulas
from .plastic import Plastic as Plastic
from .recovery import energy_ratio as energy_ratio
from .recovery import recovery as recovery
from .recovery import stress_ratio as stress_ratio
from .unloading import PUNCH_AREA as PUNCH_AREA
from .unloading import StrainScaling as StrainScaling
from .unloading import Unloading as Unloading
