"""``python -m pendulum_bags move``: move a running pendulum upright, down or to an angle, or stop it."""

from __future__ import annotations

import math
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING, Annotated

import typer

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.trajectory import thesis_ramp
from pendulum_msgs_py.errors import FaultError, ParameterError
from pendulum_msgs_py.programs.executables import EXIT_INTERRUPTED, command_line
from pendulum_msgs_py.programs.options import RunningDomain

if TYPE_CHECKING:
    from pendulum_bags.experiments.orchestrator_node import PlantClient

__all__ = ["main"]

_STOPS = {
    "stop": (names.E_STOP, "e-stop, latched; end it with: move reset"),
    "reset": (names.E_STOP_RESET, "e-stop ended; the plant is disarmed"),
}
"""Goals that are no position: service of the plant, and the text to print."""
_PATIENCE = 20.0
"""Longest wait for a node's response [s]."""
_SOON = 3.0
"""Time after which a user reads that an e-stop is not confirmed yet [s]."""


def move(
    goal: Annotated[str, typer.Argument(help="upright, down, an angle [rad]; or stop (latches the e-stop), reset.")],
    namespace: Annotated[str, typer.Option(help="Of the plant.")] = "/sim",
    control: Annotated[
        bool, typer.Option(help="upright: let the controller take over at the end. Without it the plant holds.")
    ] = True,
    domain: RunningDomain = None,
) -> int:
    """Move a pendulum under position control along the thesis's ramp: at most 0.3 rad/s.

    Deactivates the controller and arms the plant if necessary. At the end of `upright` it activates the controller,
    which takes over from position control; at the end of `down` it disarms the plant; at an angle the plant holds.
    Ctrl-C disarms it. `stop` latches the plant's e-stop, and `reset` releases it without arming. `stop` needs the
    network and this computer: on a real machine use the motion stop first. Where the plant does not confirm it, the
    exit code is 2. A request that reached a suspended program acts when it continues; its plant is in `fault` then,
    and arms only on request.

    Example: python -m pendulum_bags move upright --namespace /sim
    """
    from pendulum_bags.experiments.domain import check_domain
    from pendulum_bags.experiments.graph_plant import find_plant
    from pendulum_bags.experiments.orchestrator_node import Orchestrator, PlantClient

    place = goal if goal in {*_STOPS, "upright", "down"} else _angle(goal)
    with Orchestrator(check_domain(domain) or 0) as orchestrator:
        if place in _STOPS:
            service, said = _STOPS[str(place)]
            with _unless_confirmed(namespace) if place == "stop" else nullcontext():
                node = find_plant(orchestrator, namespace)
                PlantClient(orchestrator, namespace, node, watch=False).call(f"{node}/{service.removeprefix('~/')}")
            print(f"{namespace}: {said}", flush=True)
            return 0
        node = find_plant(orchestrator, namespace)
        plant = PlantClient(orchestrator, namespace, node)
        plant.wait_until_ready(_PATIENCE, controller=False, disturbance=False)
        orchestrator.spin(0.5)
        controlled = plant.has_controller()
        try:
            _move(plant, place, controlled=controlled, control=control)
        except KeyboardInterrupt:
            plant.disarm_quietly()
            print(f"interrupted: {namespace} is disarmed", flush=True)
            return EXIT_INTERRUPTED
        except FaultError:
            plant.disarm_quietly()
            raise
    return 0


@contextmanager
def _unless_confirmed(namespace: str) -> Iterator[None]:
    """Print what to do where a plant does not confirm its e-stop, soon and at the end; then a FaultError."""
    advice = "stop the machine by its own means (motion stop, power)"
    soon = threading.Timer(
        _SOON, lambda: print(f"{namespace}: e-stop is not confirmed yet; {advice}", file=sys.stderr, flush=True)
    )
    soon.daemon = True
    soon.start()
    try:
        yield
    except FaultError as error:
        raise FaultError(f"e-stop of {namespace} was not confirmed, and may not act: {error}; {advice}") from error
    finally:
        soon.cancel()


def _angle(text: str) -> float:
    try:
        angle = float(text)
    except ValueError:
        angle = math.nan
    if not math.isfinite(angle):
        raise ParameterError(f"goal is {text!r}; expected upright, down, stop, reset, or an angle in rad, such as 0.3")
    return angle


def _move(plant: PlantClient, goal: str | float, *, controlled: bool, control: bool) -> None:
    assert plant.sample is not None
    where, space = plant.sample.position[0], plant.namespace
    if isinstance(goal, float):
        end = goal
    else:
        # The nearest turn's goal: cables must not wind up.
        turns = round((where - (math.pi if goal == "upright" else 0.0)) / (2 * math.pi))
        end = 2 * math.pi * turns + (math.pi if goal == "upright" else 0.0)
    ramp = thesis_ramp(where, end)
    duration = ramp.duration
    if not plant.is_armed():
        if controlled and plant.controller_is_active():
            print(f"{space}: deactivating the controller", flush=True)
            plant.switch_controller(on=False)
        print(f"{space}: arming; it holds where it is", flush=True)
        plant.arm()
    print(f"{space}: moving from {where:.2f} to {end:.2f} rad in {duration:.0f} s, at most 0.3 rad/s", flush=True)
    plant.follow(ramp, "move" if isinstance(goal, float) else f"move_{goal}")
    wait = plant.orchestrator.wait_for
    wait(f"{space} to follow the ramp", plant.is_following, _PATIENCE)
    # An active controller would take over at the end; until now it may have held the pendulum.
    if controlled and plant.controller_is_active():
        print(f"{space}: under position control; deactivating the controller", flush=True)
        plant.switch_controller(on=False)
    wait(f"the end of the move of {space}", plant.trajectory_finished, duration + _PATIENCE)
    if goal == "down":
        print(f"{space}: down; disarming", flush=True)
        plant.disarm()
    elif isinstance(goal, float):
        assert plant.sample is not None
        print(f"{space}: at {plant.sample.position[0]:.2f} rad; held under position control", flush=True)
    elif controlled and control:
        print(f"{space}: upright; activating the controller", flush=True)
        plant.switch_controller(on=True)
        plant.orchestrator.spin(0.5)
        if plant.newest_mode() != "armed_effort":
            raise FaultError(f"{space} is {plant.newest_mode()}; expected the controller to have taken over")
        print(f"{space}: the controller holds it", flush=True)
    else:
        print(f"{space}: upright; held under position control", flush=True)


main = command_line(move, "python -m pendulum_bags move", context_settings={"ignore_unknown_options": True})
