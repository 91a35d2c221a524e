"""Figures of any campaign: the paper's, those of the joint calibrations, those of a discovery; headless.

Nothing is registered with pyplot.
"""

from ._bands import plot_bands as plot_bands
from ._bands import plot_fits as plot_fits
from ._before_after import plot_before_after as plot_before_after
from ._collapse import plot_collapse as plot_collapse
from ._curves import plot_curves as plot_curves
from ._dimensions import plot_dimensions as plot_dimensions
from ._discovery import discovery_figures as discovery_figures
from ._discovery import plot_gap as plot_gap
from ._discovery import plot_shifts as plot_shifts
from ._discovery import plot_where as plot_where
from ._elastic import plot_elastic as plot_elastic
from ._files import paper_figures as paper_figures
from ._files import save_figures as save_figures
from ._forest import plot_estimates as plot_estimates
from ._forest import plot_forest as plot_forest
from ._forest import plot_shrinkage as plot_shrinkage
from ._law import plot_law as plot_law
from ._least_squares import least_squares_figures as least_squares_figures
from ._least_squares import plot_whitened as plot_whitened
from ._master import plot_master as plot_master
from ._new_particle import plot_new_particle as plot_new_particle
from ._particles import particle_pages as particle_pages
from ._particles import plot_particles as plot_particles
from ._posterior import plot_pairs as plot_pairs
from ._posterior import plot_prior_posterior as plot_prior_posterior
from ._posterior import posterior_figures as posterior_figures
from ._ranking import plot_ranking as plot_ranking
from ._ranking import plot_similarity as plot_similarity
from ._residuals import plot_residuals as plot_residuals
