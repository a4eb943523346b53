"""What can be asked of many bags: a question is a file of this folder and a line in ``QUESTIONS``."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

__all__ = ["QUESTIONS", "Question"]


class Question(NamedTuple):
    """A question.

    Attributes:
        module: Where its function ``answer`` is, imported when it is asked. Of a recording it takes a ``Reading`` and
            the plant's namespace, of a run folder its path, the folder of the tables and the run's name; it returns
            columns by name.
        of_runs: Whether it is asked of run folders with the bags ``sim`` and ``hw``, and not of each plant in a bag.
    """

    module: str
    of_runs: bool = False

    def answer(self, *arguments: Any) -> Mapping[str, Any]:
        """Return the answer's columns by name."""
        answer: Callable[..., Mapping[str, Any]] = importlib.import_module(self.module).answer
        return answer(*arguments)


QUESTIONS: Mapping[str, Question] = {
    "metrics": Question("pendulum_bags.analyse.questions.metrics"),
    "timing": Question("pendulum_bags.analyse.questions.timing"),
    "identify": Question("pendulum_bags.analyse.questions.identify"),
    "compare": Question("pendulum_bags.analyse.questions.compare", of_runs=True),
    "report": Question("pendulum_bags.analyse.questions.report", of_runs=True),
}
"""Questions by name."""
