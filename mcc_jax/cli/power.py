"""`mcc-jax power`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .._store import results
from .discover import require_mechanisms
from .options import (
    CampaignFolder,
    exclude_option,
    json_option,
    law_options,
    out_option,
    priors_option,
    seed_option,
    threshold_option,
)
from .session import say, say_table, session
from .shared import joint_model, read_without, say_files, say_json, write_result

POWER = "power.json"


@click.command(short_help="Say what a planned campaign could show.")
@click.argument("campaign", type=CampaignFolder(), metavar="CAMPAIGN")
@out_option(required=True)
@exclude_option
@threshold_option(default=0.0)
@priors_option()
@law_options
@seed_option("For the record: nothing here is random.")
@json_option(POWER, "a table")
def power(campaign: Path, out: Path, seed: int, as_json: bool, **options: Any) -> None:
    """Say how large each mechanism must be for the tests in the folder CAMPAIGN to show it, and which they cannot tell
    apart. CAMPAIGN is what `mcc-jax simulate` makes of your plan with your tester's noise, or a measured campaign.

    Writes power.json into DIR.

    \b
    Example: would twelve particles with a hold and a reload do?
      mcc-jax simulate --particles twelve.csv --out planned --levels 0.5,1,1 --hold-s 20 --noise-um 0.05 --noise-mN 0.05
      mcc-jax power planned --out planned
    """
    with session(20) as tell:
        from ..discover import power_of_campaign
        from ..effects import LIBRARY

        require_mechanisms(options["exclude"])
        data = read_without(campaign, (), tell)
        with results(out) as stage:
            found = power_of_campaign(
                data,
                library={name: m for name, m in LIBRARY.items() if name not in options["exclude"]},
                model=joint_model(options),
                threshold_MPa=options["threshold_MPa"],
                progress=tell,
            )
            content: dict[str, Any] = found.to_json() | {"seed": seed}
            write_result(stage, POWER, content)
    if as_json:
        say_json(content)
        return
    rows = []
    for entry in content["mechanisms"]:
        unit = "" if entry["unit"] == "-" else f" {entry['unit']}"
        seen = "yes" if entry["visible"] else "no"
        rows.append(
            (entry["mechanism"], f"{entry['detection_limit']:.2g}{unit}", f"{entry['plausible'][1]:.2g}{unit}", seen)
        )
    say_table(("mechanism", "found from", "largest plausible", "can be seen"), rows)
    for entry in content["untestable"]:
        say(f"{entry['mechanism']} needs {entry['needs']}.")
    for entry in content["inseparable"]:
        one, other = entry["pair"]
        say(f"{one} and {other} look alike ({100 * entry['similarity']:.0f} %).")
    say()
    say_files(out, [POWER])
