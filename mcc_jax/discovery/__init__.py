"""Discovery: where law and data disagree, the name of what is missing, and whether adding it closes the gap."""

from .closure import Closure as Closure
from .discover import discover as discover
from .plan import Power as Power
from .plan import power_of_campaign as power_of_campaign
from .result import Discovery as Discovery
from .result import Effect as Effect
from .settings import DECISIONS as DECISIONS
from .settings import Decisions as Decisions
