"""``python -m pendulum_lqr convert_policy``: convert policies to ONNX, or from Stable-Baselines3 to policy files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.programs.executables import command_line, typed_options
from pendulum_msgs_py.programs.options import out_option
from pendulum_msgs_py.programs.terminal import make_console

if TYPE_CHECKING:
    from pendulum_lqr.policies.policy_import import ActorSpec

__all__ = ["main"]

_OF_IMPORT = ("plant", "period", "observation", "history", "velocity_scale", "velocity_box", "effort_limit")


def convert_policy(
    context: typer.Context,
    source: Annotated[Path, typer.Argument(help="Policy file (.npz), or an archive of Stable-Baselines3 (.zip).")],
    out: Annotated[Path, out_option("ONNX model or policy file; it must be new.")],
    plant: Annotated[str, typer.Option(help="Plant on which the archive's policy was trained: preset or file.")] = "",
    period: Annotated[float, typer.Option(help="Time between two of its answers [s]; Pendulum-v1 has 0.05.")] = 0.0,
    observation: Annotated[
        str,
        typer.Option(
            help="What it sees, in its order, of angle, cos, sin (from upright), velocity, effort; -cos and -sin are "
            "those of an angle from hanging. Default: known by its spaces (Pendulum-v1, PendulumX59-v0)."
        ),
    ] = "",
    history: Annotated[int, typer.Option(help="Samples that it sees, as VecFrameStack puts them.", min=1)] = 1,
    velocity_scale: Annotated[float, typer.Option(help="Velocity that it sees as 1 [rad/s].")] = 1.0,
    velocity_box: Annotated[
        float, typer.Option(help="Largest speed that training visited [rad/s]; default: the bound of its space.")
    ] = 0.0,
    effort_limit: Annotated[
        float, typer.Option(help="Torque of its largest action [N m]; default: the plant's limit, where both agree.")
    ] = 0.0,
) -> None:
    """Convert a policy file to ONNX, or an actor of Stable-Baselines3 (PPO, A2C, SAC, TQC) to a policy file.

    Nothing in an archive is executed, and neither library is needed. No archive shows whether observations were
    normalised in training (VecNormalize), and such an actor would differ from its archive, so train without.

    Example: python -m pendulum_lqr convert_policy build/dfki.npz --out build/dfki.onnx

    Example: python -m pendulum_lqr convert_policy sac.zip --plant my_plant.yaml --period 0.05 --out build/sac.npz
    """
    if out.exists():
        raise ParameterError(f"file {out} exists; expected a new one")
    console = make_console(highlight=False)
    if out.suffix == ".onnx":
        if ignored := typed_options(context, _OF_IMPORT):
            raise ParameterError(
                f"{', '.join(ignored)} is given, and a policy file says it itself; expected it for an archive alone"
            )
        console.print(_export(source, out), soft_wrap=True, markup=False)
        return
    if out.suffix != ".npz" or source.suffix == ".npz":
        raise ParameterError(f"--out is {out} for {source}; expected .npz to .onnx, or .zip to .npz")
    if not plant or not 0.0 < period < float("inf"):
        raise ParameterError(
            "the archive does not say on which plant and at which period it was trained; expected --plant, and "
            "a finite --period > 0"
        )
    from pendulum_lqr.policies.policy_import import ActorSpec
    from pendulum_msgs_py.plants.plant_parameters import load_plant

    for name, value in (("velocity_box", velocity_box), ("effort_limit", effort_limit)):
        if not 0.0 <= value < float("inf"):
            raise ParameterError(f"{name} is {value}; expected a finite number >= 0")
    if not 0.0 < velocity_scale < float("inf"):
        raise ParameterError(f"velocity_scale is {velocity_scale} rad/s; expected a finite number > 0")
    spec = ActorSpec(load_plant(plant), period, observation, history, velocity_scale, velocity_box, effort_limit)
    console.print(_import(source, out, spec), soft_wrap=True, markup=False)


def _export(source: Path, out: Path) -> str:
    from pendulum_lqr.policies.onnx_file import OPSET, write_onnx
    from pendulum_lqr.policies.policy_file import load_policy

    policy = load_policy(source)
    write_onnx(out, policy)
    return f"{policy.name}: observation ({policy.observation_size}) to action in -1 to 1, opset {OPSET}\nmodel   {out}"


def _import(source: Path, out: Path, spec: ActorSpec) -> str:
    from pendulum_lqr.policies.policy_file import write_policy
    from pendulum_lqr.policies.policy_import import policy_of_actor
    from pendulum_lqr.policies.sb3_archive import load_actor

    actor = load_actor(source)
    provenance = {
        "archive": source.name,
        "sha256": actor.sha256,
        "algorithm": actor.algorithm,
        "stable_baselines3": actor.version,
        "steps": actor.steps,
    }
    name = f"{spec.plant.name} {actor.algorithm}"
    policy = policy_of_actor(actor, spec, name=name, provenance=provenance)
    write_policy(out, policy)
    sizes = "-".join(str(size) for size in policy.network.sizes)
    return (
        f"{actor.algorithm} ({sizes}, {policy.network.activation}) sees {policy.provenance['observation']}, from "
        f"upright; torque within +-{policy.effort_limit[0]:g} N m, every {policy.period:g} s, up to "
        f"{policy.velocity_box[0]:.4g} rad/s\npolicy  {out}"
    )


main = command_line(convert_policy, "python -m pendulum_lqr convert_policy")
