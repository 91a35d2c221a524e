"""Cases into a folder that `benchmarks.blind.run.solve` takes.

`campaigns/k000/` and so on in an order that says nothing, `tasks.json` (what a solver is asked), `answers.json`,
`answers.sha256`.
"""

from __future__ import annotations

import hashlib
import json
from itertools import islice
from pathlib import Path

import numpy as np

from .build import build
from .plan import plan

OPTIONS = {"confirm": False, "experiments": False, "posterior": False}
"""Names are what is graded: the solver is spared the rest."""

# First numbers of the seeds; other ones would be other campaigns.
_ORDER, _CASES = 991, 17


def cases(seed, only=None, limit=None):
    """Triples (key, number, case) of the plan, of the tiers `only` and no more than `limit`."""
    whole = plan()
    order = np.random.default_rng([seed, _ORDER]).permutation(len(whole))
    keys = {int(number): f"k{place:03d}" for place, number in enumerate(order)}
    chosen = ((keys[n], n, case) for n, case in enumerate(whole) if not only or case.tier in only)
    return list(islice(chosen, limit))


def make(folder, seed=0, only=None, limit=None, progress=lambda done, total, key, answer: None):
    """Write the campaigns, the answers with their hash, the tasks.

    Raises:
        FileExistsError: if the folder holds something.
    """
    folder = Path(folder)
    if folder.exists() and any(folder.iterdir()):
        raise FileExistsError(f"{folder} holds something: name a new or empty folder")
    chosen = cases(seed, only, limit)
    answers = {}
    for key, number, case in chosen:
        built = build(case, [seed, _CASES, number])
        write(built, folder / "campaigns" / key)
        answers[key] = built.answer
        progress(len(answers), len(chosen), key, built.answer)
    answers = dict(sorted(answers.items()))
    text = json.dumps({"answers": answers}, indent=1) + "\n"
    (folder / "answers.json").write_text(text)
    (folder / "answers.sha256").write_text(hashlib.sha256(text.encode()).hexdigest() + "\n")
    tasks = {key: {"exclude": [], "options": OPTIONS} for key in answers}
    (folder / "tasks.json").write_text(json.dumps(tasks, indent=1) + "\n")


def write(built, folder):
    """`particles.csv`, `curves.csv` and `campaign.toml` of one campaign."""
    folder.mkdir(parents=True)
    tested, path = built.campaign.particles, built.campaign.path
    digits = len(str(len(tested)))
    names = [f"p{i + 1:0{digits}d}" for i in range(len(tested))]
    columns = ["particle", "D1_um", "D2_um", "D3_um"]
    rows = [f"{name},{D[0]:.2f},{D[1]:.2f},{D[2]:.2f}" for name, D in zip(names, tested.D, strict=True)]
    if tested.humidity is not None:
        columns.append("relative_humidity_percent")
        rows = [f"{row},{percent:.1f}" for row, percent in zip(rows, tested.humidity, strict=True)]
    (folder / "particles.csv").write_text("\n".join([",".join(columns), *rows]) + "\n")
    samples = zip(path.owner, path.time, path.force, built.displacement, strict=True)
    rows = [f"{names[i]},{t:.4f},{F:.5f},{gamma:.5f}" for i, t, F, gamma in samples]
    (folder / "curves.csv").write_text("\n".join(["particle,time_s,force_mN,displacement_um", *rows]) + "\n")
    (folder / "campaign.toml").write_text('control = "load"\n')
