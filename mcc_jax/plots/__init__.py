"""Figures of any campaign: the paper's, those of the joint calibrations, those of a discovery; headless.

Nothing is registered with pyplot.
"""

from .bands import plot_bands as plot_bands
from .bands import plot_fits as plot_fits
from .before_after import plot_before_after as plot_before_after
from .collapse import plot_collapse as plot_collapse
from .curves import plot_curves as plot_curves
from .dimensions import plot_dimensions as plot_dimensions
from .discovery import discovery_figures as discovery_figures
from .discovery import plot_gap as plot_gap
from .discovery import plot_shifts as plot_shifts
from .discovery import plot_where as plot_where
from .elastic import plot_elastic as plot_elastic
from .files import paper_figures as paper_figures
from .files import save_figures as save_figures
from .forest import plot_estimates as plot_estimates
from .forest import plot_forest as plot_forest
from .forest import plot_shrinkage as plot_shrinkage
from .law import plot_law as plot_law
from .least_squares import least_squares_figures as least_squares_figures
from .least_squares import plot_whitened as plot_whitened
from .master import plot_master as plot_master
from .new_particle import plot_new_particle as plot_new_particle
from .particles import particle_pages as particle_pages
from .particles import plot_particles as plot_particles
from .posterior import plot_pairs as plot_pairs
from .posterior import plot_prior_posterior as plot_prior_posterior
from .posterior import posterior_figures as posterior_figures
from .ranking import plot_ranking as plot_ranking
from .ranking import plot_similarity as plot_similarity
from .residuals import plot_residuals as plot_residuals
