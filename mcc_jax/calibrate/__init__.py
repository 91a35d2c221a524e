"""From a campaign to the law's parameters."""

from ._elastic import LEAST_RATIO as LEAST_RATIO
from ._elastic import ElasticBranch as ElasticBranch
from ._elastic import ElasticFit as ElasticFit
from ._elastic import campaign_branches as campaign_branches
from ._elastic import elastic_branches as elastic_branches
from ._elastic import fit_effective_modulus as fit_effective_modulus
from ._elastic import recoverable_strain as recoverable_strain
from ._master import MasterCurve as MasterCurve
from ._master import StrainTable as StrainTable
from ._master import master_curve as master_curve
from ._master import strain_table as strain_table
from ._paper import PaperCalibration as PaperCalibration
from ._paper import calibrate_paper as calibrate_paper
from ._plastic import PlasticFit as PlasticFit
from ._plastic import fit_polynomial as fit_polynomial
from ._plastic import fit_population as fit_population
from ._predict import ParticleFit as ParticleFit
from ._predict import point_noise_um as point_noise_um
from ._predict import predict_particles as predict_particles
from ._result import estimate as estimate
from ._shape import Objective as Objective
from ._shape import ShapeFit as ShapeFit
from ._shape import choose_reference as choose_reference
from ._shape import fit_shape_parameter as fit_shape_parameter
