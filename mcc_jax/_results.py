"""Why a computation ended: readable reasons instead of codes."""

import optimistix as optx

_NO_THROW = (
    "In a model of your own (jit, NUTS, a solver) pass throw=False: such a proposal then gets a likelihood of NaN, "
    "which is rejected, and `result` says why."
)


class RESULTS(optx.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]  # an Enumeration of Equinox, no enum
    """Results of the entry points, next to those of Optimistix."""

    successful = ""
    nonfinite_response = (
        "The law returned a number that is not finite. Three causes: a diameter that is not positive, an entry of the "
        "path that is not finite, or the law's own parameters, for instance a sampler's or solver's proposal that "
        "overflowed. " + _NO_THROW
    )
    bad_parameter = (
        "A parameter of the law is out of range: C1, C5 and the effective modulus must be positive, C3 not negative. "
        + _NO_THROW
    )
    gains_energy = (
        "With its damage or densification the particle, loaded further and released, would give back more energy than "
        "that took. Take a smaller amplitude, a stiffer effective modulus or a path that ends at a smaller strain. "
        "In a model of your own (jit, NUTS, a solver) pass throw=False and look at `result`."
    )
    no_stress = (
        "The shape factor 1 + a (1 - D3^2/(D1 D2)) is not positive, so the particle carries no stress. "
        "Take a larger (less negative) a. " + _NO_THROW
    )
