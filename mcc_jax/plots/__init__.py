"""Figures of any campaign: the paper's, those of the joint calibrations, those of a discovery; headless.

Nothing is registered with pyplot.
"""

from .curves import plot_bands as plot_bands
from .curves import plot_fits as plot_fits
from .curves import plot_new_particle as plot_new_particle
from .curves import plot_particles as plot_particles
from .curves import plot_whitened as plot_whitened
from .discovery import discovery_figures as discovery_figures
from .discovery import plot_before_after as plot_before_after
from .discovery import plot_gap as plot_gap
from .discovery import plot_ranking as plot_ranking
from .discovery import plot_shifts as plot_shifts
from .discovery import plot_similarity as plot_similarity
from .discovery import plot_where as plot_where
from .paper import paper_figures as paper_figures
from .paper import plot_collapse as plot_collapse
from .paper import plot_curves as plot_curves
from .paper import plot_dimensions as plot_dimensions
from .paper import plot_elastic as plot_elastic
from .paper import plot_law as plot_law
from .paper import plot_master as plot_master
from .paper import plot_residuals as plot_residuals
from .posterior import least_squares_figures as least_squares_figures
from .posterior import plot_estimates as plot_estimates
from .posterior import plot_forest as plot_forest
from .posterior import plot_pairs as plot_pairs
from .posterior import plot_prior_posterior as plot_prior_posterior
from .posterior import plot_shrinkage as plot_shrinkage
from .posterior import posterior_figures as posterior_figures
from .style import save_figures as save_figures
