"""Parts of the console's page without a browser: its notices, and the card of the answer."""

from __future__ import annotations

import asyncio
import json
import os
from pathlib import Path
from typing import Any

import pytest

nicegui = pytest.importorskip("nicegui")

from nicegui.testing import user_simulation  # noqa: E402

from pendulum_bags.verdict.layers import Layer, LayerResult, Mark, sum_up  # noqa: E402
from pendulum_console.console import notices  # noqa: E402
from pendulum_console.console.jobs import Jobs  # noqa: E402
from pendulum_console.console.layers_card import LayersCard  # noqa: E402
from pendulum_console.console.notices import Notices  # noqa: E402


def standing(place: Any) -> list[str]:
    """Return the words of the notices that stand, from the top."""
    return [line.default_slot.children[0].text for line in place.default_slot.children]


def test_the_newest_stand_newest_first_each_once_and_a_refusal_longer_than_a_word(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(notices, "_STAYS", {"bad": 60.0, "good": 0.2})
    shown: list[Notices] = []

    def page() -> None:
        shown.append(Notices())
        shown[0].build()

    async def press() -> None:
        async with user_simulation(page) as user:
            await user.open("/")
            one = shown[0]
            with user:
                for text in ("first", "second", "third", "fourth", "third"):
                    one.say(text, bad=True)
                assert standing(one._place) == ["third (2 times)", "fourth", "second"]
                one.say(f"r is {'9' * 5000}; expected a number", bad=True)
                top = standing(one._place)[0]
                assert top.startswith("r is 999")
                assert top.endswith("; expected a number")
                assert len(top) < 210
                refusal = "arm is refused: " + "a reason with its remedy, " * 20 + "then arm again"
                one.say(refusal, bad=True)
                assert standing(one._place)[0] == refusal
                one.say("armed")
                assert standing(one._place)[0] == "armed"
            deadline = asyncio.get_running_loop().time() + 20.0
            while "armed" in standing(one._place):
                assert asyncio.get_running_loop().time() < deadline, "a word of success stays"
                await asyncio.sleep(0.02)
            assert standing(one._place)[1].startswith("r is 999"), "refusals stay longer"

    asyncio.run(press())


def test_the_card_of_the_answer_shows_its_sentence_its_run_and_each_layer_once(tmp_path: Path) -> None:
    shown: list[LayersCard] = []

    def page() -> None:
        shown.append(LayersCard(Jobs(tmp_path)))
        shown[0].build()

    async def look() -> None:
        async with user_simulation(page) as user:
            await user.open("/")
            (card,) = shown
            with user:
                card.refresh()
                assert not card._place.visible
                for number, late in enumerate((9, 3)):
                    result = LayerResult(Layer.SAME_RUN, Mark.NO, f"It answers {late} ms later.", reason=f"{late} ms")
                    summary = tmp_path / f"run_{number}" / "summary.json"
                    summary.parent.mkdir()
                    summary.write_text(json.dumps({"answer": sum_up([result]).to_json()}), encoding="utf-8")
                    os.utime(summary, (100.0 + number, 100.0 + number))
                    card.refresh()
                    card.refresh()
                    assert card._place.visible
                    assert card._sentence.text == f"No: {late} ms."
                    assert card._run.text == f"of the run run_{number}"
                    rows = card._layers.default_slot.children
                    assert [row.tag for row in rows] == ["dt", "dd"] * 4
                    assert rows[1].default_slot.children[0].text == f"It answers {late} ms later."

    asyncio.run(look())
