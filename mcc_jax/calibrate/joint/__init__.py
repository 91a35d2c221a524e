"""Joint calibration: all particles, the population behind them and the noise at once."""

from ._arviz import to_arviz as to_arviz
from ._arviz import write_posterior as write_posterior
from ._bayes import BayesCalibration as BayesCalibration
from ._bayes import calibrate_bayes as calibrate_bayes
from ._least_squares import Identifiability as Identifiability
from ._least_squares import LeastSquaresCalibration as LeastSquaresCalibration
from ._least_squares import calibrate_least_squares as calibrate_least_squares
from ._many import calibrate_many as calibrate_many
from ._model import JointModel as JointModel
from ._noise import Noise as Noise
from ._population import Population as Population
from ._predictive import PredictedCurves as PredictedCurves
from ._predictive import beside_paper as beside_paper
from ._predictive import new_laws as new_laws
from ._predictive import predict_measured as predict_measured
from ._predictive import predict_new_particle as predict_new_particle
from ._priors import LogNormalPrior as LogNormalPrior
from ._priors import NakagamiPrior as NakagamiPrior
from ._priors import NormalPrior as NormalPrior
from ._priors import Priors as Priors
from ._priors import read_priors as read_priors
