"""How reports write numbers."""

from __future__ import annotations

import math

__all__ = ["quantity", "ratio_in_words"]

_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def quantity(value: float, unit: str = "", digits: int = 3) -> str:
    """Return a number and its unit with significant digits, as a power of ten if needed."""
    if math.isnan(value):
        return "–"
    magnitude = abs(value)
    if magnitude != 0.0 and (magnitude < 1e-4 or magnitude >= 1e6):
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        power = f"10{str(int(exponent)).translate(_SUPERSCRIPT)}"
        text = power if mantissa == "1" else f"{mantissa}×{power}"
    else:
        text = f"{value:.{digits}g}"
        if "e" in text:
            text = f"{value:.0f}"
    return f"{text.replace('-', '−')} {unit}".rstrip()


def ratio_in_words(ratio: float) -> str:
    """Return a ratio as text, such as ``12 % smaller`` or ``2.2 times as large``."""
    if 0.995 <= ratio <= 1.005:
        return "equal within half a per cent"
    if ratio >= 1.75:
        return f"{ratio:.2g} times as large"
    if ratio > 1.0:
        return f"{100.0 * (ratio - 1.0):.2g} % larger"
    return f"{100.0 * (1.0 - ratio):.2g} % smaller"
