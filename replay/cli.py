"""The command line: `egoloc COMMAND --help`. Heavy imports stand inside the commands."""

import os
import sys
from collections.abc import Sequence
from functools import reduce
from operator import or_
from typing import Annotated, Any

import tyro

from replay.commands.benchmarks import BENCHMARKS
from replay.commands.comparing import Compare, Score
from replay.commands.demo import Demo
from replay.commands.exporting import Export
from replay.commands.frames import Frames
from replay.commands.logs import Convert, Info, Simulate
from replay.commands.looking import View
from replay.commands.map_check import CheckMap
from replay.commands.map_files import ExportMap, ImportMap
from replay.commands.mapping import MapInfo
from replay.commands.noise import Allan, Noise
from replay.commands.predicting import Predict
from replay.commands.replaying import Replay
from replay.commands.surveying import Align, Surfels
from replay.commands.training import Evaluate, Train
from sensors.errors import EgolocError

COMMANDS = {
    "demo": Demo,
    "convert": Convert,
    "simulate": Simulate,
    "info": Info,
    "replay": Replay,
    "score": Score,
    "compare": Compare,
    "view": View,
    "frames": Frames,
    "allan": Allan,
    "noise": Noise,
    "train": Train,
    "eval": Evaluate,
    "predict": Predict,
    "export": Export,
}
MAPS = {
    "import": ImportMap,
    "info": MapInfo,
    "check": CheckMap,
    "surfels": Surfels,
    "align": Align,
    "export": ExportMap,
}
DESCRIPTION = "Multi-sensor localization for vehicles: replay logs through the filter and measure how well it does."
MAP_DESCRIPTION = "Vector maps: make them, look into them, judge them."
BENCH_DESCRIPTION = "Measure speed beside other libraries, and how well the filter does where it is hard."


def _one_of(commands: dict[str, Any]) -> Any:
    """The type of a choice between commands."""
    return reduce(or_, (Annotated[kind, tyro.conf.subcommand(name)] for name, kind in commands.items()))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code: 0 done, 1 some logs failed, 2 a user's mistake (one line on stderr)."""
    given = tuple(sys.argv[1:] if arguments is None else arguments)
    maps: Any = Annotated[_one_of(MAPS), tyro.conf.subcommand("map", description=MAP_DESCRIPTION)]
    bench: Any = Annotated[_one_of(BENCHMARKS), tyro.conf.subcommand("bench", description=BENCH_DESCRIPTION)]
    choices: Any = _one_of(COMMANDS) | maps | bench
    command = tyro.cli(
        choices,
        prog="egoloc",
        description=DESCRIPTION,
        args=given,
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
    )
    try:
        return command.run(("egoloc", *given)) or 0
    except EgolocError as error:
        return _fail(str(error))
    except BrokenPipeError:  # the reader of our output has gone: not an error, and nothing more to say
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except MemoryError:
        return _fail("not enough memory: try a shorter log, a lower output_hz, or a smaller map")
    except OSError as error:
        return _fail(f"{error.filename}: {error.strerror}" if error.filename else str(error))
    except KeyboardInterrupt as interrupt:
        print(": ".join(("egoloc: interrupted", *map(str, interrupt.args))), file=sys.stderr)
        return 130


def _fail(message: str) -> int:
    print(f"egoloc: error: {' '.join(message.split())}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
