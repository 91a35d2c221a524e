"""Drive one particle along a path: the entry point that compiles, checks and explains."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from .._results import RESULTS
from .._types import Path
from ..campaign import Control
from ..effects import ExtendedLaw
from ..geometry import Particle
from ..law import AbstractContactLaw


class Response(eqx.Module):
    """What a particle did along a path.

    Attributes:
        displacement: platen displacement [um].
        force: force [mN].
        monotone: False if the law's loading curve falls somewhere; under load control the displacement then jumps.
        state: the law's state after the path, to go on from.
        result: `RESULTS.successful`, or why the numbers must not be used.
    """

    displacement: Path
    force: Path
    monotone: Bool[Array, ""]
    state: Any
    result: RESULTS


@eqx.filter_jit
def drive(
    law: AbstractContactLaw | ExtendedLaw,
    particle: Particle,
    path: Path,
    *,
    time: Path | None = None,
    control: Control = "displacement",
    state: Any = None,
    throw: bool = True,
) -> Response:
    """Drive one particle along a path of displacements [um] or forces [mN].

    Batch it with `equinox.filter_vmap` over law, particle and path, or use `simulate_batch`.

    Args:
        law: any contact law, also one extended by effects.
        particle: size and shape.
        path: what the tester imposes, displacements [um] or forces [mN]; negative values are out of contact.
        time: times [s] of the path, for an extended law; other laws know no time.
        control: which of the two `path` is, "displacement" or "load".
        state: the state to start from; a virgin particle if None.
        throw: raise if the result is not successful; otherwise hand the reason back in `result`.

    Returns:
        The response; its numbers are differentiable with respect to law, particle, path and state.

    Raises:
        ValueError: if an extended law gets no times, or another law gets some.
        EquinoxRuntimeError: with `throw`, if anything in the response is not finite or the particle can carry no
            stress.
    """
    start = law.init(particle) if state is None else state
    if isinstance(law, ExtendedLaw):
        if time is None:
            raise ValueError("an extended law needs the times of the path")
        if control == "load":
            force = path
            end, displacement = law.path_load(particle, start, path, time)
        else:
            displacement = path
            end, force = law.path(particle, start, path, time)
    elif time is not None:
        raise ValueError("only a law extended by effects knows times")
    elif control == "load":
        force = path
        end, displacement = law.path_load(particle, start, path)
    else:
        displacement = path
        end, force = law.path(particle, start, path)
    finite = jnp.all(jnp.isfinite(displacement)) & jnp.all(jnp.isfinite(force))
    result = RESULTS.where(finite, RESULTS.successful, RESULTS.nonfinite_response)
    result = RESULTS.where(law.carries_stress(particle), result, RESULTS.no_stress)
    result = RESULTS.where(law.is_valid, result, RESULTS.bad_parameter)
    response = Response(displacement, force, law.is_monotone, end, result)
    return result.error_if(response, result != RESULTS.successful) if throw else response


@eqx.filter_jit
def simulate_batch(
    laws: AbstractContactLaw | ExtendedLaw,
    particles: Particle,
    paths: Array,
    *,
    times: Array | None = None,
    relative_humidity: Array | None = None,
    control: Control = "displacement",
) -> Response:
    """`drive` for N particles at once, each with its own law.

    Args:
        laws: a law whose every array field has a leading axis N.
        particles: a particle, likewise.
        paths: displacements [um] or forces [mN], shape (N, steps); pad shorter paths by repeating their last value.
        times: times [s], likewise, for laws extended by effects.
        relative_humidity: of every test [%], shape (N,), for laws extended by effects; the reference if None.
        control: "displacement" or "load".

    Returns:
        A response with a leading axis N in every field; it never raises, look at `result` and `monotone`.
    """
    if not isinstance(laws, ExtendedLaw):
        if times is not None or relative_humidity is not None:
            raise ValueError("only laws extended by effects know times and humidities")
        return eqx.filter_vmap(lambda law, particle, path: drive(law, particle, path, control=control, throw=False))(
            laws, particles, paths
        )

    def one(law: ExtendedLaw, particle: Particle, path: Array, time: Array | None, humidity: Array | None) -> Response:
        start = law.init(particle, humidity)
        return drive(law, particle, path, time=time, control=control, state=start, throw=False)

    return eqx.filter_vmap(one)(laws, particles, paths, times, relative_humidity)
