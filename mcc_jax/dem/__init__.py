"""The law between particles: half contacts in series, history that survives neighbour lists, walls. SI units."""

from ._pair import ContactEnergy as ContactEnergy
from ._pair import largest_overlap as largest_overlap
from ._pair import pair_energy as pair_energy
from ._pair import pair_force as pair_force
from ._pair import pair_split as pair_split
from ._pair import wall_energy as wall_energy
from ._pair import wall_force as wall_force
from ._side import TESTED_STRAIN as TESTED_STRAIN
from ._side import HalfContact as HalfContact
from ._side import half_contact as half_contact
from ._side import sides_of as sides_of
