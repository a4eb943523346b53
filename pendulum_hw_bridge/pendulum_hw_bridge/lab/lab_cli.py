"""``lab``: write the lab file by guided procedures; save and restore the settings of a module."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from pendulum_hw_bridge.backends import BACKENDS, hebi
from pendulum_hw_bridge.backends.hebi_discovery import LOOK_TIME, ModuleSelection, discover, select_module
from pendulum_hw_bridge.bridge.assembly import for_plant
from pendulum_hw_bridge.bridge.bridge_parameters import plant_of
from pendulum_hw_bridge.bridge.module import DrivenModule
from pendulum_hw_bridge.bridge.node_specs import SPECS
from pendulum_hw_bridge.checks.nudge import hand_of
from pendulum_hw_bridge.emulation import EMULATOR_PRESET_NAMES
from pendulum_hw_bridge.lab import guided, module_files, proofs
from pendulum_hw_bridge.port.actuator import ActuatorError, HardwareLimits, afterwards
from pendulum_hw_bridge.port.clocks import WallClock
from pendulum_hw_bridge.port.settings import expect_limits
from pendulum_msgs_py.errors import ParameterError, PendulumError
from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.plants.lab_file import DRIVES, LabFile, load_lab, write_lab
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant
from pendulum_msgs_py.programs.executables import cli_main
from pendulum_msgs_py.programs.options import Json, out_option
from pendulum_msgs_py.programs.terminal import WholeTable, make_console
from pendulum_msgs_py.programs.typed_commands import as_typed

__all__ = ["main"]

app = typer.Typer(
    help="Write the lab file of a machine by guided procedures.\n\n"
    "A first day: scan, lab new, lab backup, lab zero, lab tare, lab prove_m_stop, lab prove_lifetime, check.\n\n"
    "Example: python -m pendulum_hw_bridge lab new lab.yaml --family Lab --name Pendulum",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    add_completion=False,
)
File = Annotated[Path, typer.Argument(help="The lab file.")]
Yes = Annotated[bool, typer.Option("--yes", help="Do not wait for Enter before each step.")]


class _Terminal:
    """A person at a terminal."""

    def __init__(self, *, yes: bool) -> None:
        self._console = make_console(highlight=False)
        self._yes = yes

    def say(self, text: str) -> None:
        self._console.print(text, markup=False, soft_wrap=True)

    def go_on(self, text: str) -> None:
        self._console.print(f"\n{text}", markup=False, style="bold", soft_wrap=True)
        if self._yes:
            return
        self._console.print("Enter to go on, Ctrl-C to leave: ", end="", markup=False)
        try:
            input()
        except EOFError:
            raise ParameterError("a person is needed here; expected a terminal to press Enter on, or --yes") from None


@app.command()
def new(
    file: File,
    backend: Annotated[str, typer.Option(help="hebi, dynamixel, or emulator_process for a rehearsal.")] = "hebi",
    interface: Annotated[str, typer.Option(help="Network address to search, empty for all; bus of a drive.")] = "",
    number: Annotated[int, typer.Option("--id", help="Number of a drive on its bus.", min=0, max=252)] = 1,
    family: Annotated[str, typer.Option(help="HEBI family of the module.")] = "",
    name: Annotated[str, typer.Option(help="HEBI name of the module.")] = "",
    serial: Annotated[str, typer.Option(help="Serial number of the module.")] = "",
    module_type: Annotated[str, typer.Option(help="Type that it must be of; empty for any.")] = "X5-9",
    emulator_address: Annotated[str, typer.Option(help="HOST:PORT of an emulator.")] = "127.0.0.1:17590",
    plant: Annotated[
        str | None, typer.Option(help=f"{EMULATOR_PRESET_NAMES}, or a plant file with a drivetrain; of a drive any.")
    ] = None,
    effort: Annotated[
        float, typer.Option(help="Largest torque; of a drive at most its plant's [N m].", min=0.01)
    ] = 5.0,
    supply: Annotated[float, typer.Option(help="Voltage of the supply [V].", min=18.0, max=52.0)] = 36.0,
) -> None:
    """Look for the one module that is meant, and write a new lab file for it; nothing moves.

    Example: python -m pendulum_hw_bridge lab new lab.yaml --family Lab --name Pendulum --effort 5
    """
    if file.exists():
        raise ParameterError(f"lab file {file} is there already; expected a new one")
    if backend in DRIVES:
        _new_drive(file, backend, interface, number, plant or DRIVES[backend], effort)
        return
    values: dict[str, Any] = {"backend": backend}
    if backend == "hebi":
        modules = discover(hebi.open_lookup(interface), look_time=LOOK_TIME)
        wanted = ModuleSelection(family, name, "", serial, module_type)
        module = select_module(modules, wanted, seconds=LOOK_TIME)
        values.update(
            family=module.family,
            name=module.name,
            mac_address=module.mac_address,
            serial=module.serial,
            module_type=module.type,
        )
        if interface:
            values["interface"] = interface
    elif backend == "emulator_process":
        values["emulator_address"] = emulator_address
    else:
        raise ParameterError(f"backend is {backend!r}; expected hebi or emulator_process")
    values.update(
        joint_offset=0.0,
        joint_sign=1,
        effort_limit=effort,
        velocity_limit=1.5,
        position_window=[-4.0, 4.0],
        plant=plant or "thesis",
        effort_strategy="direct_pwm",
        feedback_rate=100.0,
        command_lifetime=0.05,
        # A supply sags under load and rises under braking.
        voltage_window=[max(22.0, round(0.85 * supply, 1)), min(50.0, round(1.15 * supply, 1))],
    )
    write_lab(file, LabFile(values))
    print(f"{file}: {LabFile(values).describe()}")
    print(as_typed(f"next: python -m pendulum_hw_bridge lab zero {file}"))


def _new_drive(file: Path, backend: str, interface: str, number: int, plant: str, effort: float) -> None:
    """Write the lab file of a drive that answers."""
    values: dict[str, Any] = {
        "interface": interface,
        "drive_id": number,
        "joint_offset": 0.0,
        "joint_sign": 1,
        "plant": plant,
    }
    values |= {"backend": backend, "effort_limit": min(effort, load_plant(plant).effort_limit)}
    values["drive_model"] = BACKENDS[backend].defaults["drive_model"]
    lab = LabFile(values)
    defaults = {spec.name: spec.default for spec in for_plant(SPECS, plant, backend)}
    port = BACKENDS[backend].make({**defaults, **values}, WallClock())
    with afterwards(port.close):
        port.connect()
    write_lab(file, lab)
    print(f"{file}: {lab.describe()}")
    print(as_typed(f"next: python -m pendulum_hw_bridge lab zero {file}"))


@app.command()
def show(file: File, as_json: Json = False) -> None:
    """Check a lab file as the bridge does, and show it with what was proved.

    Example: python -m pendulum_hw_bridge lab show lab.yaml
    """
    from pendulum_hw_bridge.checks.check_node import bridge_values

    values = bridge_values([], {"lab_file": str(file)})
    lab = load_lab(file)
    if as_json:
        print(json_text({"parameters": {name: values[name] for name in lab.values}, "proofs": lab.proofs}))
        return
    table = WholeTable("parameter", "value", title=f"{file}: {lab.name or lab.describe()}")
    for name in lab.values:
        table.add_row(name, str(values[name]))
    proofs = WholeTable("procedure", "date", "result", title="Proved")
    for name, proof in lab.proofs.items():
        proofs.add_row(name, proof.get("date", ""), proof.get("result", ""))
    console = make_console()
    console.print(table)
    console.print(proofs if lab.proofs else "Nothing was proved on it yet.")


@app.command()
def zero(file: File, yes: Yes = False) -> None:
    """Find zero and sign: let it hang, turn it by hand to either side; the motor gets no torque.

    Example: python -m pendulum_hw_bridge lab zero lab.yaml
    """
    terminal = _Terminal(yes=yes)
    with _machine(file) as (module, _):
        hand, other = hand_of(module.port, terminal.say), hand_of(module.port, terminal.say, clockwise=True)
        found = guided.find_zero_and_sign(module.port, terminal, hand, other)
    result = f"{found.offset:+.4f} rad, sign {found.sign:+d}, play {found.play:.3f} rad"
    _keep(file, "zero", result, joint_offset=round(found.offset, 5), joint_sign=found.sign)


@app.command()
def tare(file: File, yes: Yes = False) -> None:
    """Measure what the torque sensor shows when nothing pulls; the motor gets no torque.

    Example: python -m pendulum_hw_bridge lab tare lab.yaml
    """
    with _machine(file) as (module, plant):
        found = guided.measure_tare(module.port, module.settings, plant, _Terminal(yes=yes))
    _keep(file, "effort_tare", f"{found:+.3f} N m", effort_tare=round(found, 4))


@app.command(name="prove_lifetime")
def prove_lifetime(file: File, yes: Yes = False) -> None:
    """Prove that the torque ends by itself when this program falls silent; the motor turns gently.

    Example: python -m pendulum_hw_bridge lab prove_lifetime lab.yaml
    """
    with _machine(file) as (module, _), _proves(file, "command_lifetime"):
        took = proofs.prove_lifetime(
            module.port, module.settings, _Terminal(yes=yes), module.monitor.limits, module.mapping.drivetrain
        )
    _keep(file, "command_lifetime", f"torque ended {1e3 * took:.0f} ms after the last command")


@app.command(name="prove_m_stop")
def prove_m_stop(file: File, yes: Yes = False) -> None:
    """Prove that the motion stop ends the torque: press it when prompted; the motor turns gently.

    Example: python -m pendulum_hw_bridge lab prove_m_stop lab.yaml
    """
    with _machine(file) as (module, _), _proves(file, "m_stop"):
        took = proofs.prove_m_stop(
            module.port, module.settings, _Terminal(yes=yes), module.monitor.limits, module.mapping.drivetrain
        )
    _keep(file, "m_stop", f"torque ended within {1e3 * took:.0f} ms")


@app.command()
def backup(
    file: File,
    out: Annotated[Path | None, out_option("New folder. Default: next to the lab file, with the time.")] = None,
) -> None:
    """Keep the module's gains, safety parameters and M-stop action in files, as they are now.

    Before the proofs, and before the bridge connects: both set limits of their own, which a later backup holds.

    Example: python -m pendulum_hw_bridge lab backup lab.yaml --out before_us
    """
    folder = out or file.with_name(f"{file.stem}_module_{time.strftime('%Y-%m-%d_%H-%M-%S')}")
    lab = load_lab(file)
    if lab.values["backend"] == "hebi":
        group = _group(lab)
        written = module_files.backup_group(group, folder)
        ours = _ours(file, lambda limits: module_files.limits_of_group(group, limits))
    else:
        with _machine(file) as (module, _):
            written = module_files.backup_emulator(module.port, folder)
            ours = _ours(file, lambda _: module.port.connect().limits)
    if ours:
        print(
            f"note: the module holds the limits of {file}, which a proof or the bridge has set: this backup holds what "
            "the module is set to now, not what it was before us",
            file=sys.stderr,
        )
    for path in written:
        print(path)
    print(as_typed(f"give it back: python -m pendulum_hw_bridge lab restore {file} {folder}"))


@app.command()
def restore(
    file: File, folder: Annotated[Path, typer.Argument(help="Folder that ``lab backup`` wrote.")], yes: Yes = False
) -> None:
    """Give the module the gains, safety parameters and M-stop action of a backup, and read them back.

    Example: python -m pendulum_hw_bridge lab restore lab.yaml before_us
    """
    lab = load_lab(file)
    if not folder.is_dir():
        raise ParameterError(f"backup {folder} does not exist; expected a folder that lab backup wrote")
    terminal = _Terminal(yes=yes)
    terminal.go_on(
        f"Restore. Gains, safety parameters and M-stop action of {lab.describe()} become those of {folder}. Nothing "
        "moves."
    )
    if lab.values["backend"] == "hebi":
        module_files.restore_group(_group(lab), folder, hebi.new_command, terminal.say)
    else:
        with _machine(file) as (module, _):
            module_files.restore_emulator(module.port, folder, terminal.say)
    print("restored, and read back")


def _ours(file: Path, limits_of: Callable[[HardwareLimits], HardwareLimits]) -> bool:
    """Return whether a module has the limits that the bridge sets with a lab file."""
    try:
        wanted = _as_the_bridge(file)[0].settings.limits
        expect_limits(limits_of(wanted), wanted)
    except PendulumError:
        # Other limits, or an invalid lab file: nothing was set with it.
        return False
    return True


def _as_the_bridge(file: Path) -> tuple[DrivenModule, PlantParameters]:
    """Return the module of a lab file as the bridge makes it, not connected, and its plant."""
    from pendulum_hw_bridge.checks.check_node import bridge_values, machine_of

    values = bridge_values([], {"lab_file": str(file)})
    # First, because it refuses a plant of several joints.
    plant = plant_of(values)
    (module,) = machine_of(values).modules(WallClock())
    assert isinstance(module, DrivenModule)
    return module, plant


@contextlib.contextmanager
def _machine(file: Path) -> Iterator[tuple[DrivenModule, PlantParameters]]:
    """Connect the machine of a lab file; its motor is off afterwards, however the block ends."""
    module, plant = _as_the_bridge(file)
    with afterwards(module.port.close):
        module.port.connect()
        yield module, plant


@contextlib.contextmanager
def _proves(file: Path, procedure: str) -> Iterator[None]:
    """Remove an older proof from the lab file if the machine fails a new one."""
    try:
        yield
    except ActuatorError:
        lab = load_lab(file)
        if procedure in lab.proofs:
            write_lab(file, lab.no_longer_proved(procedure))
            print(f"{file}: {procedure}: no longer proved", file=sys.stderr)
        raise


def _group(lab: LabFile) -> Any:
    return hebi.connect_group(
        ModuleSelection.of({"module_type": "X5-9", **lab.values}), lab.values.get("interface", "")
    )


def _keep(file: Path, procedure: str, result: str, **values: Any) -> None:
    lab = load_lab(file).changed(**values).proved(procedure, time.strftime("%Y-%m-%d %H:%M"), result)
    write_lab(file, lab)
    print(f"{file}: {procedure}: {result}")


main = partial(cli_main, app, name="python -m pendulum_hw_bridge lab")
