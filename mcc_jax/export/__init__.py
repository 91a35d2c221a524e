"""The calibrated law for other engines: parameter card, tables, JAX artefacts, C header, recipes, golden tables."""

from .c_header import c_header as c_header
from .c_header import lammps_recipe as lammps_recipe
from .c_header import yade_recipe as yade_recipe
from .jax_artefact import Artefact as Artefact
from .jax_artefact import jax_artefact as jax_artefact
from .origin import Origin as Origin
from .origin import read_calibration as read_calibration
from .tables import CurveTables as CurveTables
from .tables import curve_tables as curve_tables
from .tables import golden_pair_table as golden_pair_table
from .tables import golden_table as golden_table
from .write import FORMATS as FORMATS
from .write import card as card
from .write import write_export as write_export
