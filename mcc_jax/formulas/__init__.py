"""The closed formulas below effects and law: loading, unloading, their inverses, stored energy; no memory."""

from .contact import Contact as Contact
from .contact import Quintic as Quintic
from .contact import energy_ratio as energy_ratio
from .contact import first_gain as first_gain
from .contact import recovery as recovery
from .contact import stored as stored
from .contact import stress_ratio as stress_ratio
from .parameters import PUNCH_AREA as PUNCH_AREA
from .parameters import Formulas as Formulas
from .parameters import Plastic as Plastic
from .parameters import StrainScaling as StrainScaling
from .parameters import Unloading as Unloading
