"""Discovery: where law and data disagree, the name of what is missing, and whether adding it closes the gap."""

from ._closure import Closure as Closure
from ._discover import discover as discover
from ._plan import Plan as Plan
from ._plan import Power as Power
from ._plan import planned_base as planned_base
from ._plan import power as power
from ._result import Discovery as Discovery
from ._result import Effect as Effect
