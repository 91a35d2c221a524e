"""From law and programme to curves: one particle, many particles, whole campaigns."""

from ._campaign import PAPER_PEAK_STRESS_MPA as PAPER_PEAK_STRESS_MPA
from ._campaign import law_for_each as law_for_each
from ._campaign import paper_campaign as paper_campaign
from ._campaign import paper_law as paper_law
from ._campaign import paper_population as paper_population
from ._campaign import simulate_campaign as simulate_campaign
from ._drive import Response as Response
from ._drive import drive as drive
from ._drive import simulate_batch as simulate_batch
from ._effects import HiddenEffect as HiddenEffect
from ._effects import read_effect as read_effect
from ._instrument import Instrument as Instrument
from ._programme import Hold as Hold
from ._programme import Programme as Programme
from ._programme import Ramp as Ramp
from ._programme import read_programme as read_programme
