"""The calibrated law for other engines: parameter card, tables, JAX artefacts, C header, recipes, golden tables."""

from ._c_header import c_header as c_header
from ._calibrated import read_calibration as read_calibration
from ._card import card as card
from ._golden import golden_pair_table as golden_pair_table
from ._golden import golden_table as golden_table
from ._jax_artefact import Artefact as Artefact
from ._jax_artefact import jax_artefact as jax_artefact
from ._origin import Origin as Origin
from ._recipes import lammps_recipe as lammps_recipe
from ._recipes import yade_recipe as yade_recipe
from ._tables import CurveTables as CurveTables
from ._tables import curve_tables as curve_tables
from ._write import FORMATS as FORMATS
from ._write import write_export as write_export
