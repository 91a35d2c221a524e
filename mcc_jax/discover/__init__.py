"""Discovery: where law and data disagree, the name of what is missing, and whether adding it closes the gap."""

from .discover import discover as discover
from .discrepancy import Closure as Closure
from .plan import Plan as Plan
from .plan import Power as Power
from .plan import planned_base as planned_base
from .plan import power as power
from .plan import power_of_campaign as power_of_campaign
from .posterior import ExtendedPosterior as ExtendedPosterior
from .result import Discovery as Discovery
from .result import Effect as Effect
