"""The console's pictures of the designs that carry over to the machine measured last."""

from __future__ import annotations

from pathlib import Path

from nicegui import ui

from pendulum_bags.verdict import Layer, read_layers
from pendulum_console.console.jobs import Jobs, NewestPage
from pendulum_msgs_py.errors import DataError

__all__ = ["CertifiedDesigns"]

PAGE = "frequency_response.html"
_KINDS = "certified for the measured machine, stabilising the model only, or neither"
PICTURES = {
    "certified_weights.png": f"Map of LQR weights, q11/r and q22/r: {_KINDS}",
    "certified_gains.png": f"Map of gains, kp and kd: {_KINDS}; the designs are marked",
}
"""File in the folder of figures, and its alternative text."""


class CertifiedDesigns:
    """Maps of certified LQR weights and gains, with the layer's sentence and a link to the page."""

    def __init__(self, jobs: Jobs) -> None:
        self._newest = NewestPage(jobs, PAGE)

    def build(self) -> None:
        """Build the card, hidden until there is a measurement."""
        with ui.element("div").classes("certified") as self._place:
            ui.html("<h3>Designs that carry over</h3>", sanitize=False)
            self._sentence = ui.label().classes("small")
            self._row = ui.element("div").classes("pictures")
            self._link = ui.link("Open the page of the measurement", "#", new_tab=True)
        self._place.set_visibility(False)

    def refresh(self) -> None:
        """Show the newest measurement."""
        if not self._newest.changed():
            return
        folder = self._newest.folder
        self._place.set_visibility(folder is not None)
        if folder is None:
            return
        self._sentence.text = _sentence(folder)
        self._link.props(f'href="/runs/{folder.name}/{PAGE}#certified_gains"')
        self._row.clear()
        with self._row:
            for name, text in PICTURES.items():
                if (folder / "figures" / name).is_file():
                    # The time stamp keeps browsers from showing a cached older measurement.
                    source = f"/runs/{folder.name}/figures/{name}?{self._newest.written:.0f}"
                    ui.element("img").props(f'src="{source}" alt="{text}" loading="lazy"')


def _sentence(folder: Path) -> str:
    try:
        found = read_layers(folder)
    except DataError as error:
        return str(error)
    return next((one.sentence for one in found if one.layer is Layer.WHICH_CONTROLLERS), "")
