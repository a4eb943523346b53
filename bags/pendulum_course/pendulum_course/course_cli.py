"""``course``: make six exercises from a seed, and check each answer."""

from __future__ import annotations

import json
import tempfile
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pendulum_msgs_py.atomic_write import writing
from pendulum_msgs_py.errors import BagError, ParameterError
from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.programs.executables import EXIT_INTERRUPTED, cli_main
from pendulum_msgs_py.programs.options import Json, out_option

if TYPE_CHECKING:
    from pendulum_course.checks import Judgement
    from pendulum_course.tasks import Tasks

__all__ = ["app", "main"]

DEFAULT = Path("build", "course")

app = typer.Typer(
    help="Make a course of six exercises, and check answers.\n\n"
    "Example: python -m pendulum_course course make --seed 2027 --out build/course",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    add_completion=False,
)
check = typer.Typer(
    help="Check the answer to an exercise: right (exit code 0) or wrong (1).\n\n"
    "Example: python -m pendulum_course course check gains --q 100,0.01 --r 0.1",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    add_completion=False,
)
app.add_typer(check, name="check")

Course = Annotated[Path, typer.Option("--course", help="Folder that `course make` wrote.")]


@app.command()
def make(
    seed: Annotated[
        int, typer.Option(help="Another seed makes another course; use the year, for instance.", min=0)
    ] = 1,
    out: Annotated[Path, out_option("Folder to write; it must be new or empty.")] = DEFAULT,
) -> None:
    """Write exercises.md, course.yaml and the sealed plant of a seed. None of them contains the seed.

    Example: python -m pendulum_course course make --seed 2027 --out build/course
    """
    from pendulum_course.exercises import exercises_text
    from pendulum_course.tasks import draw_plant, draw_tasks, write_tasks
    from pendulum_msgs_py.plants.sealed_plant import seal_plant

    if out.is_dir() and any(out.iterdir()):
        raise BagError(
            f"course folder {out} is not empty; expected a new one, so that no answers get lost: "
            "name it with --out DIR (make course OUT=DIR)"
        )
    tasks = draw_tasks(seed)
    with writing(f"course folder {out}", BagError):
        out.mkdir(parents=True, exist_ok=True)
        write_tasks(out / "course.yaml", tasks)
        (out / "hidden.yaml").write_text(seal_plant(draw_plant(seed)), encoding="utf-8")
        (out / "exercises.md").write_text(exercises_text(tasks, str(out)), encoding="utf-8")
    print(f"the exercises are in {out / 'exercises.md'}; hand out the folder, and keep the seed to yourself")


@app.command()
def solution(
    seed: Annotated[int, typer.Option(help="The seed of `course make`.", min=0)],
    as_json: Json = False,
) -> None:
    """Print the answers to the course of a seed: for the teacher.

    Example: python -m pendulum_course course solution --seed 2027
    """
    from pendulum_course.exercises import answers
    from pendulum_course.tasks import draw_plant, draw_tasks
    from pendulum_msgs_py.programs.terminal import WholeTable, make_console

    found = answers(draw_tasks(seed), draw_plant(seed))
    if as_json:
        print(json_text(found))
        return
    table = WholeTable("exercise", "answer", title=f"Answers to the course of seed {seed}")
    for name, answer in found.items():
        table.add_row(name, answer)
    make_console().print(table)


@check.command()
def gains(
    q: Annotated[str, typer.Option(help="Diagonal of Q, as `design` takes it: 100,0.01 [1/rad^2, s^2/rad^2].")],
    r: Annotated[float, typer.Option(help="R [1/(N m)^2].")],
    course: Course = DEFAULT,
    as_json: Json = False,
) -> int:
    """Exercise 1: weights for a given time constant.

    Example: python -m pendulum_course course check gains --q 100,0.01 --r 0.1
    """
    from pendulum_course.checks import check_gains
    from pendulum_lqr.design_command.design_cli import read_diagonal

    return _print_judgement(check_gains(_tasks(course), read_diagonal(q), r), as_json=as_json)


@check.command()
def plant(
    file: Annotated[Path, typer.Argument(help="Plant file that you identified.")],
    course: Course = DEFAULT,
    as_json: Json = False,
) -> int:
    """Exercise 2: the parameters of the hidden plant.

    Example: python -m pendulum_course course check plant found.yaml
    """
    from pendulum_course.checks import check_plant
    from pendulum_msgs_py.plants.plant_parameters import load_plant
    from pendulum_msgs_py.plants.sealed_plant import load_plant_to_run

    _tasks(course)
    hidden = course / "hidden.yaml"
    truth, sealed = load_plant_to_run(hidden)
    if not sealed:
        raise ParameterError(f"plant file {hidden} is not sealed; expected it as the course wrote it")
    return _print_judgement(check_plant(truth, load_plant(file)), as_json=as_json)


@check.command()
def delay(
    delay: Annotated[float, typer.Argument(help="Delay at which the loop becomes unstable [s].")],
    course: Course = DEFAULT,
    as_json: Json = False,
) -> int:
    """Exercise 3: the delay at which the pendulum falls.

    Example: python -m pendulum_course course check delay 0.5
    """
    from pendulum_course.checks import check_delay

    return _print_judgement(check_delay(_tasks(course), delay), as_json=as_json)


@check.command()
def noise(
    ratio: Annotated[float, typer.Argument(help="Factor by which the standard deviation of theta grows [-].")],
    because: Annotated[str, typer.Option(help="Explanation: a, b, c or d.")],
    course: Course = DEFAULT,
    as_json: Json = False,
) -> int:
    """Exercise 4: why noise at 500 Hz looks calmer.

    Example: python -m pendulum_course course check noise 2.2 --because a
    """
    from pendulum_course.checks import check_noise

    return _print_judgement(check_noise(_tasks(course), ratio, because), as_json=as_json)


@check.command()
def winner(
    name: Annotated[str, typer.Argument(help="a or b.")],
    course: Course = DEFAULT,
    as_json: Json = False,
) -> int:
    """Exercise 5: which controller wins on the machine. Runs both on the emulated machine, some 20 s.

    Example: python -m pendulum_course course check winner a
    """
    from pendulum_course.winner import check_winner

    def report(letter: str) -> None:
        typer.echo(f"running {letter.upper()} on the emulated machine", err=True)

    tasks = _tasks(course)
    with tempfile.TemporaryDirectory() as folder:
        try:
            judgement = check_winner(tasks, name, Path(folder), on_run=report)
        except KeyboardInterrupt:
            typer.echo("interrupted: all programs have ended", err=True)
            raise typer.Exit(EXIT_INTERRUPTED) from None
    return _print_judgement(judgement, as_json=as_json)


@check.command()
def fault(
    bag: Annotated[Path, typer.Argument(help="Recording of the bridge.")],
    course: Course = DEFAULT,
    as_json: Json = False,
) -> int:
    """Exercise 6: break the bridge, safely.

    Example: python -m pendulum_course course check fault build/broken
    """
    from pendulum_course.checks import check_fault

    return _print_judgement(check_fault(_tasks(course), bag), as_json=as_json)


def _tasks(course: Path) -> Tasks:
    from pendulum_course.tasks import read_tasks

    path = course / "course.yaml"
    if not path.is_file():
        raise BagError(
            f"course folder {course} has no course.yaml; make one with: python -m pendulum_course course make"
        )
    return read_tasks(path)


def _print_judgement(judgement: Judgement, *, as_json: bool) -> int:
    if as_json:
        print(json.dumps({"right": judgement.right, "reason": judgement.reason}))
    else:
        print(judgement)
    return 0 if judgement.right else 1


main = partial(cli_main, app, name="python -m pendulum_course course")
