"""Campaigns into a folder, answers into one file, the answers' hash into a small text file before any solver runs.

A folder holds `campaigns/c0001/` and so on, in an order that says nothing, `tasks.json` (what a solver is asked:
folder, names struck from the library, options), `answers.json` (what was hidden, with a random nonce and the digest of
each campaign) and `seal.txt` (SHA-256 of `answers.json`).
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import secrets
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

from benchmarks.blind.generator import campaigns, tiers

SEALED = Path(__file__).parent / "sealed"


class SealBroken(Exception):
    """Answers or campaigns are not the ones that were sealed."""


def _make(job):
    record, master, folder, known = job
    built = campaigns.build(tiers.from_record(record), master, known)
    digest = campaigns.write(built, folder)
    return built.answer, digest


def seal(folder, cases, master=None, jobs=2, name="blind", note="", progress=lambda done, total: None):
    """Write the campaigns of `cases`, the tasks, the answers and the seal; returns the hash."""
    folder = Path(folder)
    master = secrets.randbits(63) if master is None else int(master)
    nonce = secrets.token_hex(32)
    order = np.random.default_rng([int(nonce[:15], 16)]).permutation(len(cases))
    names = {f"c{place + 1:05d}": cases[index] for place, index in enumerate(order)}
    work = [(case.record(), master, str(folder / "campaigns" / key), None) for key, case in names.items()]
    answers, digests = {}, {}
    for key, (answer, digest) in zip(names, _spread(work, jobs), strict=True):
        answers[key], digests[key] = answer, digest
        progress(len(answers), len(cases))
    tasks = {key: {"exclude": list(case.exclude), "options": case.solver_options} for key, case in names.items()}
    content = {"schema": 1, "nonce": nonce, "master_seed": master, "campaigns": digests, "answers": answers}
    (folder / "tasks.json").write_text(json.dumps(tasks, indent=0) + "\n")
    (folder / "answers.json").write_text(json.dumps(content) + "\n")
    digest = hashlib.sha256((folder / "answers.json").read_bytes()).hexdigest()
    counts = ", ".join(f"{t} {n}" for t, n in sorted(_counts(cases).items()))
    text = f"{digest}  answers.json\nrun: {name}\ncases: {len(cases)} ({counts})\n" + (f"{note}\n" if note else "")
    (folder / "seal.txt").write_text(text)
    return digest


def _counts(cases):
    counts = {}
    for case in cases:
        counts[case.tier] = counts.get(case.tier, 0) + 1
    return counts


def _spread(work, jobs):
    if jobs <= 1 or len(work) < 4:
        yield from map(_make, work)
        return
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(_make, work, chunksize=4)


def open_answers(folder, seal_file=None, campaigns_too=True):
    """The answers, if they are the sealed ones.

    Raises:
        SealBroken: if the hash of the answers, or of a campaign still on disk, differs from the sealed one.
    """
    folder = Path(folder)
    data = (folder / "answers.json").read_bytes()
    sealed = Path(seal_file or folder / "seal.txt").read_text().split()[0]
    if hashlib.sha256(data).hexdigest() != sealed:
        raise SealBroken("answers.json is not the file that was sealed")
    content = json.loads(data)
    for key, digest in content["campaigns"].items() if campaigns_too else ():
        place = folder / "campaigns" / key
        if place.exists() and _digest(place) != digest:
            raise SealBroken(f"campaign {key} is not the one that was sealed")
    return content


def _digest(place):
    digest = hashlib.sha256()
    for name in ("particles.csv", "curves.csv", "campaign.toml"):
        digest.update((place / name).read_bytes())
    return digest.hexdigest()


def follow_up(folder, key, answer, changes):
    """New particles of the same material and effect, tested in another way, beside those tested already.

    Both are written as `campaigns/KEY+next`, the new particles after the old ones; the new ones' answer is returned.
    """
    case = answer["case"]
    record = {**case, **changes, "id": f"{case['id']}+next"}
    place, made = Path(folder) / "campaigns" / f"{key}+next", Path(folder) / "campaigns" / key
    new = _make((record, answer["master_seed"], str(place), answer["effects"]))[0]
    for name in ("particles.csv", "curves.csv"):
        header, *later = (place / name).read_text().splitlines()
        first, *before = (made / name).read_text().splitlines()
        if header != first:
            raise ValueError(f"{place / name} has other columns than {made / name}")
        renamed = [f"next-{row}" for row in later]
        (place / name).write_text("\n".join([header, *before, *renamed]) + "\n")
    return new
