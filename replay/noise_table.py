"""What `egoloc noise` prints for people."""

from collections.abc import Sequence

from rich.table import Table

from fusion.adaptive import Found
from fusion.innovations import AxisInnovations
from replay.noise import RunNoise, config_lines
from replay.table import DASH, bare_table, output_console

UNITS = {"lasting_s": " s", "lasting_m": " m"}


def print_noise(noise: RunNoise) -> None:
    """Innovations as they were, what makes them most likely, innovations under that, and the lines to paste."""
    console = output_console()
    console.print("Innovations over their stated sigmas, as the run left them:\n")
    console.print(_innovations(noise.innovations))
    found = noise.found
    if found is None:
        console.print(f"\nNote: no noise was looked for: {noise.missing}.", soft_wrap=True)
        return
    console.print(f"\nMost likely noise ({found.runs} runs of the filter):\n", soft_wrap=True)
    console.print(_estimates(tuple(found.found.values())))
    console.print("\nInnovations under it:\n")
    console.print(_innovations(found.after))
    console.print("\nFor a config (its sigma floors, where larger, still hold):\n", soft_wrap=True)
    console.print(config_lines(found), markup=False, soft_wrap=True)


def _innovations(axes: Sequence[AxisInnovations]) -> Table:
    table = bare_table(2)
    table.add_column("\nsensor")
    table.add_column("\naxis")
    for header in ("\ncount", "mean square\nover variance", "share that\nlasts", "time\ns"):
        table.add_column(header, justify="right", no_wrap=True)
    for axis in axes:
        lasts = DASH if axis.correlation_s is None else f"{axis.correlation_s:.2g}"
        factor = f"{axis.factor:.3f} +- {axis.factor_error:.3f}"
        table.add_row(axis.sensor.name.lower(), axis.axis, str(axis.count), factor, f"{axis.share:.2f}", lasts)
    return table


def _estimates(found: Sequence[Found]) -> Table:
    table = bare_table(2)
    table.add_column("fusion.")
    table.add_column("value", justify="right", no_wrap=True)
    table.add_column("95 % interval", justify="right", no_wrap=True)
    table.add_column("")
    for each in found:
        note = "at the bound of the search" if each.at_bound else "" if each.observed else "this drive does not tell"
        unit = UNITS.get(each.name.split(".")[1], "")
        table.add_row(each.name, f"{each.value:.3g}{unit}", f"{each.low:.3g} .. {each.high:.3g}", note)
    return table
