"""The contact inside other particle codes in JAX. Importing this needs none of them."""

from .jaxdem_force import jaxdem_force_model as jaxdem_force_model
from .jaxmd import edges_from_jaxmd as edges_from_jaxmd
