"""Runs one pathological campaign through Python or the command, and judges how it ends."""

from __future__ import annotations

import json
import re
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from click.testing import CliRunner
from pathological_kinds import MODULUS_MPA, Kind

from mcc_jax import Campaign, InputError, write_campaign
from mcc_jax.calibrate import calibrate_paper, least_squares
from mcc_jax.cli.main import cli

METHODS: dict[str, Callable[[Campaign], Any]] = {"paper": calibrate_paper, "least-squares": least_squares}
COMMAND = "command least-squares"


class Outcome(NamedTuple):
    """How one case ended: "converged", "not converged", "refused" or "failed"; the error's line, or the warnings; and
    what is wrong with this end, empty if nothing is."""

    how: str
    text: str
    fault: str


def campaign_of(kind: Kind, seed: int) -> Campaign:
    return kind.make(np.random.default_rng([seed, *kind.name.encode()]))


def run_one(kind: Kind, seed: int, method: str) -> Outcome:
    """Run one case by one method and judge how it ends."""
    campaign: Campaign | None = None
    content: dict[str, Any] | None = None
    text, fault = "", ""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            campaign = campaign_of(kind, seed)
            if method == COMMAND:
                content, text = _command(campaign)
            else:
                content = METHODS[method](campaign).to_json()
    except InputError as error:
        text = str(error)
        if not error.remedy:
            fault = "an error without a remedy"
    except Exception as error:  # whatever it is, it is what is looked for
        where = traceback.extract_tb(error.__traceback__)[-1]
        fault = f"{type(error).__name__} at {Path(where.filename).name}:{where.lineno}: {error}"
    if campaign is not None and content is not None:
        how = "converged" if content["converged"] else "not converged"
        return Outcome(how, " | ".join(content["warnings"]), _judge_result(kind, method, content, campaign))
    if fault:
        return Outcome("failed", text, fault)
    return Outcome("refused", text, _judge_refusal(kind, text))


def _judge_refusal(kind: Kind, text: str) -> str:
    if kind.reads:
        return f"valid data refused: {text}"
    if "\n" in text or len(text) > 1200:
        return f"not one line: {text}"
    if "()" in text:
        return f"no reason given: {text}"
    if kind.says and kind.says not in text:
        return f"does not say {kind.says!r}: {text}"
    return ""


def _judge_result(kind: Kind, method: str, content: dict[str, Any], campaign: Campaign) -> str:
    try:
        json.dumps(content, allow_nan=False)
    except ValueError:
        return "a number that is not finite: " + ", ".join(_not_finite(content))
    if kind.refused:
        return "should have been refused"
    why_not = [entry["why_not"] for entry in content.get("particles", ())]
    if any(entry["kept"] == bool(entry["why_not"]) for entry in content.get("particles", ())):
        return "a particle left out without its reason"
    if kind.says and not any(why and kind.says in why for why in why_not):
        return f"no particle's reason says {kind.says!r}: {why_not}"
    if not content["converged"] and not content["warnings"]:
        return "not converged, and no word why"
    if kind.suspect and content["converged"] and not content["warnings"]:
        return "nonsense without a warning"
    if kind.slip and not content.get("findings", True) and not content["warnings"]:
        return "a slip without a word"
    if kind.modulus and "paper" not in method and content["converged"]:
        modulus = content["effective_modulus_MPa"]["value"]
        true = campaign.metadata.other.get("simulation", {}).get("effective_modulus_MPa", MODULUS_MPA)
        if not 1 / kind.modulus < modulus / true < kind.modulus:
            return f"modulus {modulus:.4g} MPa where {true:.4g} is true"
    return ""


def _not_finite(content: Any, name: str = "") -> Iterator[str]:
    if isinstance(content, dict):
        for key, value in content.items():
            yield from _not_finite(value, f"{name}.{key}")
    elif isinstance(content, list | tuple):
        for i, value in enumerate(content):
            yield from _not_finite(value, f"{name}[{i}]")
    elif isinstance(content, float) and not np.isfinite(content):
        yield f"{name.lstrip('.')} = {content}"


def _command(campaign: Campaign) -> tuple[dict[str, Any] | None, str]:
    """`mcc-jax calibrate` on the campaign's files: the result, or the one line of the error."""
    with tempfile.TemporaryDirectory() as folder:
        place, out = Path(folder) / "campaign", Path(folder) / "out"
        write_campaign(campaign, place)
        arguments = ["calibrate", str(place), "--out", str(out), "--method", "least-squares", "--no-figures"]
        ended = CliRunner().invoke(cli, arguments, prog_name="mcc-jax")
        if (out / "calibration.json").exists():
            assert ended.exit_code not in (1, 2), f"exit status {ended.exit_code} with a result: {ended.stderr}"
            return json.loads((out / "calibration.json").read_text(encoding="utf-8")), ""
    line = ended.stderr.strip()
    assert ended.exit_code == 2, f"exit status {ended.exit_code}: {line}"
    assert re.fullmatch(rf"mcc-jax: error: .*{re.escape(str(place))}.*\. [A-Z].*", line), f"no file or remedy: {line}"
    return None, line
