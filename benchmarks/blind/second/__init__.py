"""A second blind test by another author: 135 campaigns whose hidden effects follow the specification alone.

The generator was written without sight of the library or of the first generator, and stays so: its modules use NumPy
and the standard library only and import nothing of `mcc_jax` or `benchmarks.blind.generator`, because that the two
generators are independent is the point of having two. A misreading of the specification shared by the library and the
first generator would pass there and fail here. Only `grading` and the command line know the solver's bench.

`particles`, `path`, `noise` and `campaign` draw what is tested and how; `law` computes the displacement; `effects` are
the formulas; `projection` and `strength` give an effect its size; `plan` lists the cases, `build` makes one, `folder`
writes them. Units: um, mN, MPa, s.
"""
