"""The paper's figures for any campaign, headless, as `matplotlib.figure.Figure`; nothing is registered with pyplot."""

from ._collapse import plot_collapse as plot_collapse
from ._curves import plot_curves as plot_curves
from ._dimensions import plot_dimensions as plot_dimensions
from ._elastic import plot_elastic as plot_elastic
from ._files import paper_figures as paper_figures
from ._files import save_figures as save_figures
from ._law import plot_law as plot_law
from ._master import plot_master as plot_master
from ._particles import particle_pages as particle_pages
from ._particles import plot_particles as plot_particles
from ._residuals import plot_residuals as plot_residuals
