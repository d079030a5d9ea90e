"""What benchmarks have in common: counts to check, one core, a table or JSON."""

import math
from collections.abc import Callable
from contextlib import nullcontext
from typing import Annotated, Any, Literal

import tyro

from replay.commands.output import print_json, stage
from sensors.errors import EgolocError

Number = Annotated[int, tyro.conf.arg(metavar="N")]
Hours = Annotated[float, tyro.conf.arg(metavar="H")]


def at_least_one(**options: int) -> None:
    """Raise for an option, by its name, of which there are none."""
    for name, value in options.items():
        if value < 1:
            raise EgolocError(f"--{name}: expected 1 or more, got {value}")


def above_zero(**options: tuple[float, ...]) -> None:
    """Raise for an option, by its name, without numbers or with one that is no length of time."""
    for name, values in options.items():
        if not values or not all(0.0 < value < math.inf for value in values):
            raise EgolocError(
                f"--{name}: expected numbers above 0, got {', '.join(f'{v:g}' for v in values) or 'none'}"
            )


def timed(name: str, work: Callable[[], Any], as_json: bool) -> None:
    """A benchmark of speed."""
    from replay.table import bench_table

    printed(name, lambda _: work(), bench_table, as_json)


def printed(
    name: str,
    work: Callable[[Callable[[str], None]], Any],
    table: Callable[[Any], Any],
    as_json: bool,
    cores: Literal["one", "all"] = "one",
) -> None:
    """Run, print the result as a table or as JSON. work: hears where it may tell what it is doing."""
    from replay.bench.measure import one_core
    from replay.table import output_console

    with stage(f"benchmark {name}") as tell, one_core() if cores == "one" else nullcontext():
        result = work(tell)
    if as_json:
        print_json(result)
    else:
        output_console().print(table(result))
