"""Missing effects: mechanisms the law does not contain, each a family of formulas, and the law extended by them."""

from ._context import Context as Context
from ._effect import AbstractEffect as AbstractEffect
from ._extended import ExtendedLaw as ExtendedLaw
from ._extended import ExtendedState as ExtendedState
from ._library import LIBRARY as LIBRARY
from ._library import default_library as default_library
from ._library import find_variant as find_variant
from ._library import present as present
from ._record import HUMIDITY_COLUMN as HUMIDITY_COLUMN
from ._record import REFERENCE_HUMIDITY_PERCENT as REFERENCE_HUMIDITY_PERCENT
from ._record import Record as Record
from ._record import clean_record as clean_record
from ._record import humidities as humidities
from ._record import record_batch as record_batch
from ._record import record_of as record_of
from ._signature import signatures as signatures
from ._variant import EQUIVALENCES as EQUIVALENCES
from ._variant import Equivalence as Equivalence
from ._variant import Mechanism as Mechanism
from ._variant import Need as Need
from ._variant import Nuisance as Nuisance
from ._variant import Variant as Variant
