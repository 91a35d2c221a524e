"""Instrument files into campaigns: four known formats, and a mapping file for any other text table."""

from .read import read_diameters as read_diameters
from .read import read_instrument_file as read_instrument_file
