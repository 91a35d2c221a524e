"""Solvers for the tests of the bench: each is called as the adapter's are."""

import os
import time


def discovery(verdict, effects=(), sets=(), **more):
    """A `discovery.json` with little in it; effects are (mechanism, probability)."""
    return {
        "schema": 1,
        "verdict": verdict,
        "summary": "",
        "where": [],
        "closure": None,
        "effects": [{"mechanism": m, "variant": "v", "probability": p, "parameters": {}} for m, p in effects],
        "candidate_set": [list(s) for s in sets],
        "ranking": [{"mechanism": m, "probability": p} for m, p in effects],
        "gap": {"floor": 1.0, "steps": []},
        **more,
    }


def silent(folder, *, seed=0):
    """Never finds anything; names its process."""
    return discovery("NO_GAP", summary=str(os.getpid()))


def naming(folder, *, seed=0):
    """Names something in every campaign of an odd number."""
    return discovery("NAMED", [("creep", 1.0)], [["creep"]]) if int(folder.name[1:]) % 2 else discovery("NO_GAP")


def moody(folder, *, seed=0):
    """Crashes, hangs, dies or talks nonsense, by the name of the campaign."""
    mood = folder.name
    if mood == "crash":
        raise ValueError("no")
    if mood == "hang":
        time.sleep(60)
    if mood == "die":
        os._exit(3)
    if mood == "nonsense":
        return {"verdict": "PERHAPS", "effects": []}
    return discovery("NO_GAP")
