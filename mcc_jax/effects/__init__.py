"""Mechanisms that the law does not contain, each a family of formulas; `MccLaw(..., effects=)` takes them."""

from .effect import AbstractEffect as AbstractEffect
from .effect import AbstractModulusAtPeak as AbstractModulusAtPeak
from .effect import Factors as Factors
from .library import LIBRARY as LIBRARY
from .library import find_variant as find_variant
from .record import HUMIDITY_COLUMN as HUMIDITY_COLUMN
from .record import REFERENCE_HUMIDITY_PERCENT as REFERENCE_HUMIDITY_PERCENT
from .record import Context as Context
from .record import Record as Record
from .record import clean_record as clean_record
from .variant import EQUIVALENCES as EQUIVALENCES
from .variant import Equivalence as Equivalence
from .variant import Mechanism as Mechanism
from .variant import Need as Need
from .variant import Nuisance as Nuisance
from .variant import Variant as Variant
