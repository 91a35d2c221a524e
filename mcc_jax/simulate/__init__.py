"""From law and programme to curves: one particle, many particles, whole campaigns."""

from .._results import RESULTS as RESULTS
from .campaign import PAPER_PEAK_STRESS_MPA as PAPER_PEAK_STRESS_MPA
from .campaign import HiddenEffect as HiddenEffect
from .campaign import law_for_each as law_for_each
from .campaign import paper_campaign as paper_campaign
from .campaign import paper_law as paper_law
from .campaign import paper_population as paper_population
from .campaign import read_effect as read_effect
from .campaign import simulate_campaign as simulate_campaign
from .drive import Response as Response
from .drive import drive as drive
from .drive import simulate_batch as simulate_batch
from .programme import Hold as Hold
from .programme import Instrument as Instrument
from .programme import Programme as Programme
from .programme import Ramp as Ramp
from .programme import read_programme as read_programme
