"""The hidden effects: for each listed mechanism an exact form and variants of the same physics, and forms on no list.

A hook is f(amplitude, value, state) and changes one step of `law.simulate`: "shape", "C1", "C3", "C5", "flow" (with x),
"overstress", "modulus", "recovered_fraction", "recovery", "strain", "observable". Every effect is nil at amplitude
zero. Conventions: displacement in um, force in mN, stress in MPa; u = F / F_P, sigma_P and eps_P the largest stress and
its strain.
"""

from . import cycles, loading, machine, time, unlisted, unloading
from .form import HUMIDITY as HUMIDITY
from .form import RELOAD as RELOAD
from .form import Effect as Effect
from .form import Form as Form

LISTED = (*machine.FORMS, *time.FORMS, *unloading.FORMS, *cycles.FORMS, *loading.FORMS)
UNLISTED = unlisted.FORMS

BY_NAME = {(form.mechanism, form.form): form for form in (*LISTED, *UNLISTED)}
