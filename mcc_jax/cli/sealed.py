"""What the demo hides in its tests: drawn by the seed, sealed before anything is computed, and compared at the end."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ..simulate import HiddenEffect

SEALED = "sealed.json"

STRENGTHS = {
    "reload_hysteresis": (0.15, 0.3),
    "frame_compliance": (2e-3, 4e-3),
    "creep": (3e-4, 6e-4),
    "unloading_shape": (0.08, 0.15),
}
"""What may be hidden, and between which amplitudes: effects that eight particles show beyond doubt.

`benchmarks/results/` says how often weaker and other ones are found.
"""


@dataclass(frozen=True)
class Sealed:
    """An answer that nobody can change unnoticed.

    Attributes:
        effect: what is hidden.
        text: the answer with a number used once, without which the few possible answers could be tried.
    """

    effect: HiddenEffect
    text: str

    @property
    def sha256(self) -> str:
        """The seal: `sha256sum sealed.json` gives it, too."""
        return hashlib.sha256(self.text.encode()).hexdigest()


def sealed_answer(seed: int) -> Sealed:
    """Draw what is hidden, how strong it is, and the number used once."""
    import numpy as np

    from ..effects import find_variant
    from ..simulate import HiddenEffect

    rng = np.random.default_rng([seed, 0x5EA1])
    name = list(STRENGTHS)[int(rng.integers(len(STRENGTHS)))]
    low, high = STRENGTHS[name]
    amplitude = float(f"{low * (high / low) ** rng.random():.3g}")
    effect = HiddenEffect(find_variant(name), amplitude)
    variant = effect.variant
    answer = {
        "mechanism": name,
        "variant": variant.name,
        "parameters": {variant.parameter: amplitude} | {n.name: n.middle for n in variant.nuisances},
        "nonce": rng.bytes(16).hex(),
    }
    return Sealed(effect, json.dumps(answer) + "\n")


def compared(answer: dict[str, Any], found: dict[str, Any]) -> tuple[bool, str]:
    """Whether a discovery named what was hidden, and in a sentence how name and amplitude agree.

    Args:
        answer: contents of `sealed.json`.
        found: contents of `discovery.json`.
    """
    hidden = answer["mechanism"]
    named = [effect["mechanism"] for effect in found["effects"]]
    if named != [hidden]:
        told = " and ".join(map(_plain, named)) or f"no name (verdict {found['verdict']})"
        return False, f"The discovery is WRONG: hidden was {_plain(hidden)}, found was {told}."
    effect = found["effects"][0]
    rivals = [_plain(name) for name in found["candidate_set"][0] if name != hidden]
    doubt = f", though these tests cannot tell it from {' or '.join(rivals)}" if rivals else ""
    if effect["variant"] != answer["variant"]:
        formulas = f"{_plain(effect['variant'])}, hidden was {_plain(answer['variant'])}"
        return True, f"The name agrees{doubt}; the formula is another ({formulas}), so amplitudes do not compare."
    name, true = next(iter(answer["parameters"].items()))
    value, sd, ends = (effect["parameters"][name][key] for key in ("value", "sd", "interval_95"))
    where = "unknown" if ends is None else "inside" if ends[0] <= true <= ends[1] else "OUTSIDE"
    off = f"{100 * (value / true - 1):+.1f} %"
    spread = "" if not sd else f", {abs(value - true) / sd:.1f} standard deviations"
    return True, (
        f"The name agrees{doubt}. The amplitude found is off by {off}{spread}; "
        f"the true one lies {where} its 95 % interval."
    )


def _plain(name: str) -> str:
    return name.replace("_", " ")
