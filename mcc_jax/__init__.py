"""Loading-unloading contact law of micro-crystalline cellulose particles: simulate, calibrate, discover, embed.

Everything public is here or in `mcc_jax.law`, `mcc_jax.campaign`, `mcc_jax.simulate`, `mcc_jax.calibrate` and
`mcc_jax.plots`. Units: MPa, um, mN, s, nJ. Switch JAX to double precision first, unless you mean single:
`jax.config.update("jax_enable_x64", True)`.
"""

from ._errors import InputError as InputError
from ._results import RESULTS as RESULTS
from .calibrate import PaperCalibration as PaperCalibration
from .calibrate import calibrate_paper as calibrate_paper
from .campaign import Campaign as Campaign
from .campaign import Curve as Curve
from .campaign import Metadata as Metadata
from .campaign import Segment as Segment
from .campaign import adjust as adjust
from .campaign import batch as batch
from .campaign import find_segments as find_segments
from .campaign import read_campaign as read_campaign
from .campaign import read_tester_file as read_tester_file
from .campaign import write_campaign as write_campaign
from .geometry import Particle as Particle
from .geometry import elastic_shape_factor as elastic_shape_factor
from .geometry import plastic_shape_factor as plastic_shape_factor
from .law import AbstractContactLaw as AbstractContactLaw
from .law import Energy as Energy
from .law import History as History
from .law import LogNormal as LogNormal
from .law import MccLaw as MccLaw
from .law import Plastic as Plastic
from .law import PlasticPopulation as PlasticPopulation
from .law import StrainScaling as StrainScaling
from .law import Unloading as Unloading
from .simulate import Hold as Hold
from .simulate import Instrument as Instrument
from .simulate import Programme as Programme
from .simulate import Ramp as Ramp
from .simulate import Response as Response
from .simulate import drive as drive
from .simulate import law_for_each as law_for_each
from .simulate import paper_campaign as paper_campaign
from .simulate import paper_law as paper_law
from .simulate import paper_population as paper_population
from .simulate import simulate_batch as simulate_batch
from .simulate import simulate_campaign as simulate_campaign

__version__ = "0.1.0"
