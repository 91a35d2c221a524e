"""The page: everything that the templates show, gathered and rendered."""

from __future__ import annotations

import math
import re
from functools import cache
from typing import Any

from .. import arguments
from .._extras import extra
from .._format import interval, listed, number, percent, plain, probability, with_sd
from .._types import Progress
from .._version import __version__
from ..calibrate.curves import KINDS, FittedCurve
from ..calibrate.estimates import exponential
from ..campaign import PAPER_EFFECTIVE_MODULUS_MPA, PAPER_LOG_C, PAPER_SHAPE_PARAMETER
from ..campaign.findings import has_error
from ..discovery.sentences import headline, verdict_in_words
from .read import Results

with extra("report"):
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup, escape

    from ..plots.style import particle_labels
    from . import texts
    from .chart import LOOKS, chart, chart_scripts, compare
    from .checks import Check, check_results, share_inside, tested
    from .story import cards, data_uri, example_of, example_pictures

CAPTIONS = {
    "bands": ("compare", "Measured curves and the central 95 % of what the posterior expects"),
    "fits": ("compare", "Measured curves and the joint fit"),
    "particles": ("compare", "Measured curves, the mean law, and each particle's own coefficients"),
    "residuals": ("compare", "What the law leaves, over force"),
    "whitened": ("compare", "Residuals freed of their correlation, which should be noise"),
    "dimensions": ("measured", "Sizes and shapes of the particles"),
    "curves": ("measured", "All curves"),
    "collapse": ("law", "Stress over strain, as measured and scaled by the shape factor"),
    "master": ("law", "The master curve and its scatter"),
    "law": ("law", "The mean law"),
    "elastic": ("law", "Recovered strain on unloading, from which the effective modulus comes"),
    "pairs": ("posterior", "How the numbers of the population depend on each other"),
    "prior_posterior": ("posterior", "What the data added to the priors"),
    "forest": ("posterior", "Coefficients of every particle, and the population behind them"),
    "estimates": ("posterior", "Coefficients of every particle, and the population behind them"),
    "shrinkage": ("posterior", "Each particle alone, and among the others"),
    "new_particle": ("posterior", "What a particle never measured would do"),
    "discovery_where": ("discovery", "Where law and tests disagree"),
    "discovery_before_after": ("before_after", "What the law leaves, before and after"),
    "discovery_ranking": ("discovery", "Every mechanism against the law alone"),
    "discovery_gap": ("discovery", "The gap on held-out particles"),
    "discovery_similarity": ("discovery", "How alike the mechanisms look in these tests"),
    "discovery_shifts": ("discovery", "What the missing effect had done to the parameters"),
    "discovery_bands": ("compare", "Measured curves and the central 95 % of what the posterior expects"),
    "discovery_prior_posterior": ("posterior", "What the data added to the priors"),
}
"""Section and caption of every figure, by its stem."""
WITHIN_A_NUMBER = re.compile(r"(?<=[\d)]) (?=[±×%]|(?:µm|[GM]Pa|mN|s)\b)|(?<=[±×]) (?=[\d(])")
"""Blanks at which a line must not break: before a unit, and around the sign of a standard deviation or a power."""


def report_page(results: Results, *, progress: Progress | None = None) -> str:
    """One self-contained HTML page of what `read_results` gives; equal input, equal page.

    `progress` is called with the name of each step. Raises `RuntimeError` in single precision.
    """
    arguments.double_precision("the report")
    with extra("report"):
        import bokeh  # noqa: F401
    progress = progress or (lambda _: None)
    progress("predicting every particle")
    results = results.with_discovery
    shown = compare(results)
    progress("drawing the page")
    return _environment().get_template("page.html").render(context(results, shown))


@cache
def _environment() -> Environment:
    # Every text of the data passes through here: autoescape has no exceptions in the templates but our own scripts.
    found = Environment(
        loader=PackageLoader("mcc_jax.report"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_unbroken,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # Bokeh wants a model before what refers to it.
    found.policies["json.dumps_kwargs"] = {"sort_keys": False, "allow_nan": False, "separators": (",", ":")}
    paper = {"a": PAPER_SHAPE_PARAMETER, "modulus_MPa": PAPER_EFFECTIVE_MODULUS_MPA, "log_C": PAPER_LOG_C}
    found.globals |= {"plain_name": texts.quantity, "exp": math.exp, "paper": paper, "methods": texts.METHODS}
    numbers, words = (number, percent, probability, with_sd, interval, exponential), (plain, listed)
    filters = (*numbers, *words, texts.spread, texts.equation)
    found.filters |= {one.__name__: one for one in filters} | {"verdict": verdict_in_words}
    return found


def _unbroken(value: Any) -> Any:
    """What a template prints, with every number in one piece; our own scripts and styles as they are."""
    return WITHIN_A_NUMBER.sub("\N{NO-BREAK SPACE}", value) if type(value) is str else value


def context(results: Results, shown: list[FittedCurve]) -> dict[str, Any]:
    """What the templates show of results and of the curves `shown`."""
    labels = particle_labels([one.name for one in shown], 40)
    checks, example, campaign = check_results(results, shown), example_of(results, shown), results.campaign
    simulated = campaign is not None and campaign.metadata.simulated
    sentences = [] if results.calibration is None else [*texts.calibration_sentences(results.calibration, results.law)]
    if results.discovery is not None:
        sentences.insert(0, headline(results.discovery, "simulated tests" if simulated else "tests"))
    measured_only = f"{len(campaign or ())} particles were measured; nothing has been calibrated on them yet."
    return {
        "results": results,
        "version": __version__,
        "simulated": simulated,
        "verdict": sentences[0] if sentences else measured_only,
        "pictures": [] if example is None else example_pictures(example),
        "caption": "" if example is None else example.caption,
        "cards": _cards(results, checks),
        "summary": sentences[1:],
        # A command is copied: its blanks stay as they are.
        "next_steps": [(text, escape(command)) for text, command in texts.next_steps(results)],
        "facts": [] if campaign is None else texts.measured(campaign),
        "rows": texts.particle_rows(results),
        "shown": shown,
        "bands": share_inside(shown) is not None,
        "labels": labels,
        "legend": sorted({LOOKS[KINDS[k]] for one in shown for k in one.kind.tolist()}, key=lambda look: look[2]),
        "chart": chart(shown, labels, texts.particle_facts(results, shown)) if shown else None,
        "bokeh": Markup(chart_scripts()) if shown else "",
        "checks": checks,
        "changes": [] if results.discovery is None else list(texts.changes(results.discovery)),
        "figures_of": _figures(results),
        "law": results.law,
        "law_alone": results.law_alone,
        "versions": next((one.versions for one in results.provenance.values() if one.versions), {}),
    }


def _cards(results: Results, checks: list[Check]) -> list[tuple[str, str, str, str]]:
    """The answers at the top, of the discovery, the calibration and the checks: level, heading, answer and meaning."""
    content, found = results.calibration, [] if results.discovery is None else list(cards(results.discovery))
    if content is None:
        return found
    used = sum(entry["kept"] for entry in content["particles"])
    of = "" if results.law == "the law" else f" of {results.law}"
    done, trusted = content["converged"], not has_error(tested(results))
    good, look, bad = ([f"“{c.check}”" for c in checks if c.level == one] for one in ("good", "look", "bad"))
    failed, conspicuous = len(checks) - len(good), listed([*bad, *look]) if bad or look else "nothing is conspicuous"
    count = f"{failed} of {len(checks)} fail" if failed else f"all {len(checks)} hold"
    expected = ": to be expected, since it lacks what was found" if (bad or look) and results.law_alone else ""
    state = "Not converged" if not done else "Converged" if trusted else "Not to be trusted"
    particles = f"{used} of {len(content['particles'])} particles, by {texts.METHODS[content['method']]}"
    level, hold = "bad" if bad else "look" if look else "good", count if trusted else "Numbers cannot be true"
    return [
        *found,
        ("good" if done and trusted else "bad", f"Calibration{of}", state, particles),
        (level, f"Checks{of}", hold, conspicuous + expected),
    ]


def _figures(results: Results) -> dict[str, list[tuple[str, str]]]:
    """Pictures and captions by section; on a page of the law with what was found, those without it separately."""
    sections = ("measured", "law", "compare", "posterior", "discovery", "before_after", "alone")
    found: dict[str, list[tuple[str, str]]] = {name: [] for name in sections}
    for kind, (section, caption) in CAPTIONS.items():
        if section in ("law", "compare", "posterior") and results.has_found != kind.startswith("discovery"):
            section = "alone" if results.has_found else "discovery"
        stems = sorted(stem for stem in results.figures if re.fullmatch(rf"{kind}(_\d+)?", stem))  # of several pages
        found[section] += [(data_uri(results.figures[stem]), caption) for stem in stems]
    return found
