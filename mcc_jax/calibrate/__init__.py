"""From a campaign to the law's parameters."""

from .campaigns import calibrate_many as calibrate_many
from .campaigns import compare as compare
from .curves import FittedCurve as FittedCurve
from .data import select_tests as select_tests
from .draws import Fit as Fit
from .fitting import fit as fit
from .least_squares import LeastSquares as LeastSquares
from .least_squares import least_squares as least_squares
from .numpyro_model import Model as Model
from .paper import PaperCalibration as PaperCalibration
from .paper import calibrate_paper as calibrate_paper
from .paper_steps import fit_shape_parameter as fit_shape_parameter
from .paper_steps import strain_table as strain_table
from .posterior import Posterior as Posterior
from .posterior import sample as sample
from .predict import compare_with_paper as compare_with_paper
from .predict import predict_measured as predict_measured
from .predict import predict_new_particle as predict_new_particle
from .predict import sample_laws as sample_laws
from .priors import LogNormalPrior as LogNormalPrior
from .priors import NakagamiPrior as NakagamiPrior
from .priors import NormalPrior as NormalPrior
from .priors import Priors as Priors
from .priors import read_priors as read_priors
from .results import Calibration as Calibration
from .results import load as load
