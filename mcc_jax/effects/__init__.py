"""Missing effects: mechanisms the law does not contain, each a family of formulas, and the law extended by them."""

from .context import Context as Context
from .derivatives import signatures as signatures
from .effect import AbstractEffect as AbstractEffect
from .extended import ExtendedLaw as ExtendedLaw
from .extended import ExtendedState as ExtendedState
from .library import LIBRARY as LIBRARY
from .library import available_data as available_data
from .library import default_library as default_library
from .library import find_variant as find_variant
from .record import HUMIDITY_COLUMN as HUMIDITY_COLUMN
from .record import REFERENCE_HUMIDITY_PERCENT as REFERENCE_HUMIDITY_PERCENT
from .record import Record as Record
from .record import clean_record as clean_record
from .record import humidities as humidities
from .record import record_batch as record_batch
from .record import record_of as record_of
from .variant import EQUIVALENCES as EQUIVALENCES
from .variant import Equivalence as Equivalence
from .variant import Mechanism as Mechanism
from .variant import Need as Need
from .variant import Nuisance as Nuisance
from .variant import Variant as Variant
