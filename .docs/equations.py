"""Formulas as the library writes them, in plain text, turned into TeX for the pages."""

import re

GREEK = {
    **{name: rf"\{name}" for name in ("sigma", "tau", "kappa", "gamma", "mu", "alpha", "pi", "Delta")},
    "eps": r"\epsilon",
    "eta": r"\eta",
    "phi": r"\varphi",
}
FUNCTIONS = {
    **{name: rf"\{name}" for name in ("exp", "ln", "sin", "min")},
    "ld": r"\log_2",
    "lg": r"\log_{10}",
}
UNITS = {"um": "µm", "mN": "mN", "MPa": "MPa", "s": "s", "mN/s": "mN/s", "MPa/s": "MPa/s", "%": r"\%"}
RATES = {"eps": r"\dot{\epsilon}", "sigma": r"\dot{\sigma}", "F": r"\dot{F}"}
"""With a prime these are derivatives by time; `u'` and `tau'` are other values of the same quantity."""
NAMES = {"RH": r"\mathrm{RH}", "dy": r"\mathrm{d}y", "dt": r"\mathrm{d}t"}
_WORDS = re.compile(r"\\text\{[^{}]*\}(?:\s*\\text\{[^{}]*\})+")
_TOKEN = re.compile(
    r"(?P<phrase>\bon a reload\b)|"
    r"(?P<rate>\b(?:eps|sigma|F)')"
    r"|(?P<quantity>\d+(?:\.\d+)?(?: (?:mN/s|MPa/s|um|mN|MPa|s|%)(?![A-Za-z_'^])|/s\b))"
    r"|(?P<number>\d+(?:\.\d+)?)"
    r"|(?P<name>[A-Za-z]+\d?(?:_[A-Za-z0-9]+)?)"
    r"|(?P<positive>\)\+(?=[\]\s)]|$))"
    r"|(?P<both>-\+)"
    r"|(?P<other>\S)|(?P<space>\s+)"
)


def in_tex(equation: str) -> str:
    """The formula in TeX: letters as variables, words upright, exponents raised."""
    parts: list[str] = []
    rest = equation
    while rest:
        if rest[0] == "^":
            exponent, rest = _bracketed(rest[1:])
            parts.append("^{" + in_tex(exponent) + "}")
            continue
        if root := re.match(r"sqrt(?=[(\[])", rest):
            inside, rest = _bracketed(rest[root.end() :])
            parts.append(rf"\sqrt{{{in_tex(inside)}}}")
            continue
        match = _TOKEN.match(rest)
        rest = rest[match.end() :]
        parts.append(_written(match))
    return _WORDS.sub(lambda m: rf"\text{{ {' '.join(re.findall(r'[^{} ]+(?= *})', m[0]))} }}", "".join(parts)).strip()


def _bracketed(text: str) -> tuple[str, str]:
    """The content of the leading brackets, or the single leading number or letter; and the rest."""
    if text[0] in "([":
        depth = 0
        for end, sign in enumerate(text):
            depth += (sign in "([") - (sign in ")]")
            if depth == 0:
                return text[1:end], text[end + 1 :]
    found = re.match(r"-?(?:\d+(?:\.\d+)?|[A-Za-z]+)", text)
    return found[0], text[found.end() :]


def _written(match: re.Match) -> str:
    kind, text = match.lastgroup, match[0]
    match kind:
        case "rate":
            return RATES[text[:-1]]
        case "quantity":
            number, unit = re.match(r"([\d.]+) ?(.*)", text).groups()
            if unit == "/s":
                return rf"{number}\,\mathrm{{s}}^{{-1}}"
            return rf"{number}\,\mathrm{{{UNITS[unit]}}}"
        case "name":
            return _name(text)
        case "phrase":
            return rf"\text{{ {text} }}"
        case "positive":
            return ")_{+}"
        case "both":
            return r"\mp "
        case "space":
            return " "
    return {"*": "^{*}", "%": r"\%", ";": r";\quad ", ",": r",\;"}.get(text, text)


def _name(text: str) -> str:
    stem, _, below = text.partition("_")
    if stem in FUNCTIONS:
        return FUNCTIONS[stem] + " "
    number = re.fullmatch(r"([A-Z])(\d)", stem)
    if number:
        return f"{number[1]}_{number[2]}"
    known = GREEK.get(stem) or NAMES.get(stem)
    if known is None:
        if len(stem) > 1 and not below:
            return rf"\text{{ {stem} }}"  # a word
        known = stem if len(stem) == 1 else rf"\mathrm{{{stem}}}"
    if not below:
        return known + (" " if known.startswith("\\") else "")
    return f"{known}_{{{below if len(below) == 1 else rf'\mathrm{{{below}}}'}}}"
