"""Drive one particle along a path: the entry point that compiles, checks and explains."""

from __future__ import annotations

from typing import Any, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from .. import arguments
from .._errors import InputError
from .._format import described
from .._results import RESULTS
from .._types import Path
from ..campaign import Control
from ..effects import AbstractModulusAtPeak
from ..geometry import Particle
from ..law import AbstractContactLaw, MccLaw


class Response(eqx.Module):
    """Response of a particle along a path.

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

    __repr__ = described(displacement="um", force="mN")


def drive(
    law: AbstractContactLaw,
    particle: Particle,
    path: Any,
    *,
    time: Any = None,
    control: Control = "displacement",
    state: Any = None,
    throw: bool = True,
) -> Response:
    """Drive one particle along a path of displacements [um] or forces [mN].

    A particle whose damage or densification would let it gain energy somewhere up to the largest strain of the path is
    refused (`MccLaw.gain_strain`). The numbers are differentiable with respect to law, particle, path and state.

    Args:
        law: any contact law, with or without effects.
        particle: size and shape; several at once: `simulate_batch`, or `equinox.filter_vmap`.
        path: displacements or forces, shape (n,); negative ones are out of contact.
        time: times [s] of the path, for a law with effects only.
        control: what `path` is, "displacement" or "load".
        state: the state to start from; a virgin particle if None.
        throw: raise if the result is not successful; otherwise hand the reason back in `result`. Pass False inside a
            sampler's model or a solver, which may propose parameters without sense: raised there, it ends the run.

    Raises:
        InputError: for unfit arguments; with `throw`, naming effects and strain, if the particle would gain energy.
        EquinoxRuntimeError: with `throw`, if the response is not finite or the particle can carry no stress; within
            compiled code also if it would gain energy.
    """
    arguments.choice(control, get_args(Control), "control")
    path = arguments.path(path, "path", many="Several particles at once: simulate_batch, or equinox.filter_vmap.")
    if jnp.ndim(particle.D3):
        raise InputError("the particle has a batch axis", remedy="Several at once: simulate_batch.")
    if time is not None:
        time = arguments.path(time, "time")
        arguments.same_length(path=path, time=time)
    _check_times(law, time is not None, "time")
    response = _drive(law, particle, path, time, control, state)
    if not throw:
        return response
    result = response.result
    if not any(map(arguments.is_traced, jax.tree.leaves(result))) and result == RESULTS.gains_energy:
        raise refusal(law, particle, response)
    return result.error_if(response, result != RESULTS.successful)


def refusal(law: AbstractContactLaw, particle: Particle, response: Response, name: str = "the particle") -> InputError:
    """Why the numbers of a response must not be used: of a gain of energy with effects, strain and remedy."""
    if response.result != RESULTS.gains_energy:
        return InputError(f"{name}: {RESULTS[response.result]}")
    names = ", ".join(e.name for e in getattr(law, "effects", ()) if isinstance(e, AbstractModulusAtPeak))
    beyond = f"loaded beyond a strain of {float(law.gain_strain(particle, response.state)):.2g}"
    problem = f"with {names or 'its law'} {name}, {beyond} and released, would give back more energy than that took"
    remedy = "Take a smaller amplitude, a stiffer effective modulus, or a path that ends below that strain."
    return InputError(problem, remedy=remedy)


@eqx.filter_jit
def _drive(
    law: Any, particle: Particle, path: Path, time: Path | None, control: Control, state: Any, humidity: Any = None
) -> Response:
    """The compiled part of `drive`, its arguments checked."""
    if state is None:
        state = law.init(particle) if humidity is None else law.init(particle, humidity)
    driven = law.path_load if control == "load" else law.path
    end, answer = driven(particle, state, path) if time is None else driven(particle, state, path, time)
    displacement, force = (answer, path) if control == "load" else (path, answer)
    finite = jnp.all(jnp.isfinite(displacement)) & jnp.all(jnp.isfinite(force))
    passive = jnp.isinf(law.gain_strain(particle, end))
    result = RESULTS.where(passive, RESULTS.successful, RESULTS.gains_energy)
    result = RESULTS.where(finite, result, RESULTS.nonfinite_response)
    result = RESULTS.where(law.carries_stress(particle), result, RESULTS.no_stress)
    result = RESULTS.where(law.is_valid, result, RESULTS.bad_parameter)
    return Response(displacement, force, law.is_monotone, end, result)


_drive_each = eqx.filter_jit(eqx.filter_vmap(_drive))


def simulate_batch(
    laws: AbstractContactLaw,
    particles: Particle,
    paths: Any,
    *,
    times: Any = None,
    relative_humidity: Any = None,
    control: Control = "displacement",
) -> Response:
    """`drive` for N particles at once, each with its own law: a response with a leading axis N in every field; what it
    cannot drive it marks in `result`.

    Args:
        laws, particles: a law and a particle whose every array field has a leading axis N.
        paths: displacements [um] or forces [mN], shape (N, steps); pad shorter paths by repeating their last value.
        times: times [s], likewise, for laws with effects.
        relative_humidity: of every test [%], shape (N,), for laws with effects; the reference if None.
        control: what `paths` are, "displacement" or "load".
    """
    arguments.choice(control, get_args(Control), "control")
    _check_times(laws, times is not None, "times")
    if relative_humidity is not None and not getattr(laws, "effects", ()):
        raise InputError("only laws with effects know humidities", remedy="Leave out relative_humidity.")
    paths = arguments.values(paths, "paths", shape="an array of shape (N, steps)")
    if paths.ndim != 2 or paths.size == 0:
        remedy = "For one particle take drive." if paths.ndim < 2 else None
        raise InputError(f"paths must have the shape (N, steps), got {paths.shape}", remedy=remedy)
    times = None if times is None else arguments.values(times, "times")
    humidity = None if relative_humidity is None else arguments.values(relative_humidity, "relative_humidity")
    batches = {"laws": laws, "particles": particles, "times": times, "relative_humidity": humidity}
    for name, batch in batches.items():
        shape = paths.shape if name == "times" else paths.shape[:1]
        for leaf in jax.tree.leaves(eqx.filter(batch, eqx.is_array)):
            if leaf.shape[: len(shape)] != shape:
                problem = f"paths have the shape {paths.shape}, and an array of {name} has {leaf.shape}"
                remedy = "Make a batch with equinox.filter_vmap, for instance mcc_jax.simulate.law_for_each."
                raise InputError(f"{problem}: they must be as many", remedy=remedy)
    return _drive_each(laws, particles, paths, times, control, None, humidity)


def _check_times(law: AbstractContactLaw, given: bool, name: str) -> None:
    """A law with effects needs times; one without does not know them. Laws of one's own may have either."""
    if not isinstance(law, MccLaw) or given == bool(law.effects):
        return
    if given:
        raise InputError("only a law with effects knows times", remedy=f"Leave out {name}.")
    raise InputError("a law with effects needs the times of its path", remedy=f"Pass {name}=[...] in seconds.")
