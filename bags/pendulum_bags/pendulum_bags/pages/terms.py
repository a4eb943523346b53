"""The terms of a report, each explained in one sentence, and links to that from the text."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from html import escape
from typing import NamedTuple

from pendulum_msgs_py.programs.typed_commands import as_typed

__all__ = ["TERMS", "Html", "Term", "Terms"]


class Html(str):
    """Text that is HTML already; templates do not escape it again."""

    __slots__ = ()

    def __html__(self) -> str:
        """Return itself, by the protocol of templates."""
        return self


class Term(NamedTuple):
    """A term, a regular expression for its words, and its meaning."""

    name: str
    words: str
    meaning: str


TERMS: Mapping[str, Term] = {
    "std": Term(
        "standard deviation (std), spread",
        r"std|standard deviations?|spread(?:s)?",
        "Root of the mean squared distance from the mean. It says how far a quantity strays, and nothing of how fast.",
    ),
    "rms": Term(
        "root mean square (rms)", r"rms|root mean squares?", "Root of the mean of the squares; an offset counts in it."
    ),
    "mean-angle": Term(
        "mean angle difference",
        r"mean angle difference|mean angle",
        "Mean of the hardware's angle less that of the simulation, over the whole run.",
    ),
    "ratio": Term(
        "ratio",
        r"\(ratio\)|[Rr]atios?",
        "The hardware's spread over the simulation's; 1 is equal. Intervals and margins of ratios are symmetric in the "
        "logarithm: 0.87 is as far from 1 as 1.15. Both motions are first taken at the slower plant's "
        "sampling times, which are the same phases of the noise, and in one band, so the ratio of velocities may "
        "differ from that of the spreads over all samples.",
    ),
    "interval": Term(
        "90 % interval, 95 % interval",
        r"9\d % interval|intervals?(?! at the recorder)|95 % from",
        "Procedures that make such intervals cover the true value in 90 (or 95) of 100 repetitions.",
    ),
    "jackknife": Term(
        "block jackknife",
        r"block jackknife|independent blocks",
        "The run is cut into blocks that are nearly independent. The estimate is computed again without each of them; "
        "how far these estimates scatter gives the interval. Few blocks make a wide interval.",
    ),
    "long-run": Term(
        "long-run spread",
        r"[Ll]ong-run",
        "The spread of a run without end under the same noise. The response to the recorded noise is separated from "
        "the rest, so that what this noise did by chance in a few seconds does not count.",
    ),
    "tost": Term(
        "two one-sided tests",
        r"[Tt]wo one-sided tests",
        "Equivalence is shown when the whole interval lies within the margin. One test of nine suffices for a "
        "difference, "
        "so it needs a wider interval, each test at a ninth of the error, that lies outside.",
    ),
    "equivalent": Term(
        "equivalent, not equivalent, undecided",
        r"not equivalent|equivalent|[Uu]ndecided",
        "Equivalent: the interval lies within the margin. Not equivalent: it lies outside. Undecided: it lies across, "
        "and more data may tell. Undecided is not a yes.",
    ),
    "margin": Term(
        "margin",
        r"default margins?|margins?",
        "The largest difference that does not matter for the purpose. You choose it; it is not a result. "
        "The default margins are those of this software.",
    ),
    "smallest-margin": Term(
        "smallest margin that would hold",
        r"smallest margin that would hold",
        "The margin at which this run would just have shown equivalence.",
    ),
    "more-runs": Term(
        "runs to add",
        r"runs to add",
        "How many more runs like these would probably decide an open test; an estimate from the width of its interval.",
    ),
    "delay": Term(
        "delay",
        r"response delay|delay",
        "By how much the hardware responds one and the same disturbance later than the simulation. It has transport, "
        "sampling and the actuator's lag in it. The test takes it at one phase of the noise samples; the shift of the "
        "cross-correlation's peak does not, and is larger by up to a period.",
    ),
    "distance": Term(
        "distance",
        r"distances? of (?:angles|velocities)|paths apart|distances",
        "Root mean square of the difference of both motions at equal times, in per cent of the hardware's standard "
        "deviation; 141 % is what two independent motions of equal spread have.",
    ),
    "less-delay": Term(
        "less the delay",
        r"less the delay|taken out",
        "After one motion was shifted by the delay: the delay does not explain what is left.",
    ),
    "deadline": Term(
        "missed deadline",
        r"missed deadlines|deadlines were missed",
        "A state that came later than its period allows. It reflects the load of the computer, not the pendulum.",
    ),
    "held": Term(
        "noise sample held for",
        r"noise sample held for|held for",
        "How long each random torque stays. Noise that is held longer moves a pendulum more, whatever the pendulum.",
    ),
    "effective": Term(
        "effective samples",
        r"effective samples?(?: sizes)?",
        "Number of independent samples that would determine the mean as accurately: successive samples are similar, so "
        "it is smaller than the number of samples.",
    ),
    "fit": Term("fit", r"fits", "100 %: the curves are equal; 0 %: no better than a constant at the mean."),
    "correlation": Term(
        "correlation", r"correlation", "1: both rise and fall together; 0: unrelated; taken at a stated shift in time."
    ),
    "coherence": Term(
        "coherence",
        r"coherent|coherence",
        "Share of one signal's power at a frequency that a linear relation with the other explains, 0 to 1.",
    ),
    "ks": Term(
        "Kolmogorov-Smirnov distance D, and p",
        r"Kolmogorov-Smirnov distances?",
        "D is the largest gap between two distributions. p is the probability of a gap at least as large if both were "
        "one; a large p is no proof that they are one, and with few effective samples it says little.",
    ),
    "effort-squared": Term("∫u² dt", r"∫u² dt", "Integral of the squared torque: how hard the controller worked."),
    "mean-end": Term(
        "mean error at the end",
        r"mean error at the end|steady state error",
        "Mean of the angle error over the last tenth of the run. Under noise it is chance, and differs from run to "
        "run: whether there is an offset is what the mean angle difference tests.",
    ),
    "smoothness": Term(
        "smoothness", r"smoothness", "Root mean square change of the torque within 20 ms; small is smooth."
    ),
    "eigenvalue": Term(
        "eigenvalue",
        r"eigenvalues?|Eigenvalues?",
        "A motion of the linearised system grows or decays as e to the power (eigenvalue times time); negative decays.",
    ),
    "weights": Term(
        "Q₁₁, Q₂₂, R, K",
        r"Q₁₁|Q₂₂",
        "The LQR minimises the integral of Q₁₁ θ² + Q₂₂ θ′² + R u²; K is the gain that does, u = −K x.",
    ),
    "regression": Term(
        "standard error, t, R² (uncentred)",
        r"standard error|R² \(uncentred\)",
        "Standard error: spread of the estimate if the errors were independent, which neighbours in time are not. t: "
        "estimate over standard error. R²: share of the squared torque that the fit explains, counted from zero.",
    ),
    "strategy": Term(
        "effort strategy",
        r"effort strategy",
        "How the actuator makes torque of a command: direct_pwm sets the voltage, so the motor's own braking acts as "
        "damping (some 12 N m s/rad); the others close a torque loop, which takes most of it away. Parameters "
        "that were found under different strategies cannot be compared.",
    ),
    "seed": Term("seed", r"seed", "The number from which all random torques follow: the same seed, the same noise."),
    "revision": Term(
        "revision", r"revision", "The state of the source code (git); +changes means that it was edited after that."
    ),
}
"""All terms that a report explains, by the anchor of the sentence."""

_COMMANDS = re.compile(
    r"python -m pendulum_\w+ [^;:()]*?(?=\)|;|:| \(|,? then\b|\.(?:\s|$)|$)"
    r"|make experiment(?: ARGS=\"[^\"]*\")?|--\w+ \w+\.yaml"
)


class Terms:
    """Marks commands and terms in the texts of one page, and records which terms the page used.

    ``explained`` are the terms by anchor: those of comparisons, or none if the words mean something else.
    """

    def __init__(self, explained: Mapping[str, Term] = TERMS) -> None:
        self._used: set[str] = set()
        # Longest words first: "not equivalent" contains "equivalent".
        ranked = sorted(explained.items(), key=lambda item: -len(item[1].words.split("|")[0]))
        groups = "|".join(f"(?P<{key.replace('-', '_')}>{term.words})" for key, term in ranked)
        self._words = re.compile(rf"(?<![\w-])(?:{groups or '(?!)'})(?![\w-])")

    @property
    def used(self) -> Iterable[tuple[str, Term]]:
        """The terms that texts of the page named so far, with their anchors."""
        return [(key, term) for key, term in TERMS.items() if key in self._used]

    def mark(self, text: str) -> Html:
        """Return a text as HTML: commands as code, the first mention of each term linked to its sentence."""
        pieces = []
        seen: set[str] = set()
        end = 0
        for found in _COMMANDS.finditer(text):
            pieces += [self._linked(text[end : found.start()], seen), f"<code>{escape(as_typed(found[0]))}</code>"]
            end = found.end()
        pieces.append(self._linked(text[end:], seen))
        return Html("".join(pieces))

    def _linked(self, text: str, seen: set[str]) -> str:
        pieces = []
        end = 0
        for found in self._words.finditer(text):
            key = str(found.lastgroup).replace("_", "-")
            if key in seen:
                continue
            seen.add(key)
            self._used.add(key)
            link = f'<a class="term" href="#term-{key}">{escape(found[0])}</a>'
            pieces += [escape(text[end : found.start()]), link]
            end = found.end()
        return "".join([*pieces, escape(text[end:])])
