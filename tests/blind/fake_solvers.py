"""Solvers for the tests of the bench: each is called as the adapter's are."""

import os
import time

import numpy as np


def _discovery(verdict, effects=(), sets=(), **more):
    return {
        "schema": 1,
        "verdict": verdict,
        "summary": "",
        "effects": [{"mechanism": m, "variant": "v", "probability": p, "parameters": {}} for m, p in effects],
        "candidate_set": [list(s) for s in sets],
        "ranking": [],
        "untestable": [],
        "where": [],
        "closure": None,
        "gap": {"floor": 1.0, "steps": [{"added": None, "chi2_per_dof": 1.0, "elpd": 0.0, "elpd_se": 1.0}]},
        "next_experiments": [],
        "runtime_s": 0.1,
        **more,
    }


def silent(folder, *, exclude=(), seed=0, options=None):
    """Never finds anything; repeats what it was asked."""
    return _discovery("NO_GAP", runtime_s=time.time(), asked=options)


def moody(folder, *, exclude=(), seed=0, options=None):
    """Answers, crashes, hangs, dies or talks nonsense, by the name of the campaign."""
    mood = int(folder.name[1:6]) % 6
    if mood == 1:
        raise ValueError("no")
    if mood == 2:
        time.sleep(60)
    if mood == 3:
        os._exit(3)
    if mood == 4:
        return {"verdict": "PERHAPS", "effects": []}
    if mood == 5:
        return _discovery("SET", [("creep", 0.6)], [["creep", "frame_compliance"]],
                          next_experiments=[{"experiment": "hold for 60 s at the peak", "separates": []}])  # fmt: skip
    return _discovery("NO_GAP")


def unsteady(folder, *, exclude=(), seed=0, options=None):
    """Answers otherwise each time."""
    return _discovery("NO_GAP", summary=str(np.random.default_rng().random()))
