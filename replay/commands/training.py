"""egoloc train and eval: weights of EgoVM, and what they are worth."""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from replay.commands.output import print_json, stage
from sensors.errors import EgolocError

if TYPE_CHECKING:
    from egovm.dataset import EvaluationBatches
    from egovm.made_samples import Split
    from egovm.network import EgoVM
    from egovm.train_config import TrainConfig

SAMPLES = Path("runs/samples")
Number = Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="(default: the config's)")]


@dataclass(frozen=True)
class Train:
    """Train EgoVM on made-up worlds: streets, and a LiDAR that turns in them.

    Writes RUN: config.toml, log.jsonl (losses and errors of each step), checkpoint.pt and at the end
    weights.safetensors. A training that was stopped, or killed, goes on with --resume and ends in the same weights.
    """

    config: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="CONFIG")]
    """small-lidar (half an hour on two cores), a TOML file, or with --resume the run folder."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="RUN", help_behavior_hint="(default: runs/CONFIG)")] = None
    """The run folder; it must not hold a training yet."""
    resume: bool = False
    """Go on with the training of the run folder from its last checkpoint."""
    steps: Number = None
    """Steps of training, from the first on."""
    seed: Number = None
    """Of the first weights, the order of the samples, and all noise."""
    ablation: Annotated[
        str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="(default: the config's, else none)")
    ] = None
    """A1 to A6, what the paper leaves out in its Table 4."""
    samples: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = SAMPLES
    """Made samples are kept there, half a MB each."""

    def run(self, _: tuple[str, ...]) -> None:
        """Train, and say where the weights are."""
        # before torch is loaded: threads that wait for each other on a busy machine take the cores from what they wait
        # for, and steps take ten times as long
        os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
        from egovm.train import resume, train
        from egovm.train_config import read_training

        if self.resume:
            changed = [name for name in ("out", "steps", "seed", "ablation") if getattr(self, name) is not None]
            if changed:
                raise EgolocError(f"--{changed[0]}: expected none with --resume: a training goes on as it was begun")
            folder = Path(self.config)
            folder = folder if folder.is_dir() else Path("runs") / self.config
            with _steps() as tell:
                weights = resume(folder, self.samples, tell)
        else:
            config = self._changed(read_training(self.config))
            folder = self.out or Path("runs") / Path(self.config).stem
            with _steps(config.steps) as tell:
                weights = train(config, folder, self.samples, tell)
        print(f"Weights: {weights}")

    def _changed(self, config: "TrainConfig") -> "TrainConfig":
        import msgspec

        names = ("steps", "seed", "ablation")
        changes = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        if changes.get("steps", 1) < 1 or changes.get("seed", 0) < 0:
            raise EgolocError("--steps, --seed: expected 1 or more and 0 or more")
        return msgspec.structs.replace(config, **changes)


@dataclass(frozen=True)
class Evaluate:
    """Judge weights on worlds that no training has seen: errors along, across and in yaw, and of its covariance.

    The row of the initial pose is what doing nothing would give. With --calibrate, covariances are first fitted to the
    errors on worlds that are neither trained nor judged on. The fit is kept in NAME-calibration.toml beside the
    weights; poses stay as they are.
    """

    weights: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="WEIGHTS")]
    """small-lidar (comes with egoloc), or a .safetensors file with its .toml beside it."""
    noise: Literal["uniform", "uniform-3", "gauss"] = "uniform"
    """Of initial poses: +-2.5 m and deg; +-3; normal of 1.5 m, 0.75 m, 0.85 deg."""
    frames: Annotated[int, tyro.conf.arg(metavar="N")] = 500
    """How many frames."""
    calibrate: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="(default: none)")] = None
    """Fit a calibration to so many frames, 800 say, with noise uniform and gauss and all kinds of --map in turns."""
    map: Literal["full", "no-surfels", "lines", "thinned"] = "full"
    """What there is of the map: all; no surfels; neither surfels nor poles and signs; a share of all, by frame."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Of the noise of initial poses."""
    samples: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = SAMPLES
    """Made samples are kept there, half a MB each."""
    json: bool = False
    """Print JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Run all frames and print the table."""
        import msgspec

        from egovm.calibration import read_calibration
        from egovm.evaluate import evaluate
        from egovm.network import EgoVM
        from egovm.weights import load_weights, read_config, weights_path
        from replay.egovm_table import evaluation_table
        from replay.table import output_console

        if self.frames < 1 or self.seed < 0:
            raise EgolocError("--frames, --seed: expected 1 or more and 0 or more")
        path = weights_path(self.weights)
        config = read_config(path)
        network = EgoVM(config)
        load_weights(network, path)
        if config.lidar is None:
            raise EgolocError(f"{path}: expected a network with a lidar: made-up worlds have no images yet")
        if self.calibrate is not None:
            self._calibrate(network, path)
        calibration = read_calibration(path, config.solver.lattice)
        with stage(f"{self.frames} frames") as say:
            batches = self._batches(network, self.frames, "held-out")
            report = evaluate(network, batches, calibration, tell=lambda done: say(f"{done}"))
        fit = None if calibration.fit is None else msgspec.to_builtins(calibration.fit)
        report = {"weights": str(self.weights), "noise": self.noise, "map": self.map, "calibration": fit, **report}
        if self.json:
            print_json(report)
        else:
            output_console().print(evaluation_table(report))

    def _calibrate(self, network: "EgoVM", path: Path) -> None:
        """Fit a calibration and write it beside the weights."""
        from egovm.calibration import calibration_path, write_calibration
        from egovm.calibration_fit import FEWEST
        from egovm.evaluate import calibrate

        assert self.calibrate is not None
        if self.calibrate < FEWEST:
            raise EgolocError(f"--calibrate: expected {FEWEST} frames or more, got {self.calibrate}")
        if not os.access(path.parent, os.W_OK):  # before minutes of work
            raise EgolocError(f"{calibration_path(path)}: cannot be written: the folder may not be written to")
        with stage(f"{self.calibrate} frames of the calibration") as say:
            batches = self._batches(network, self.calibrate, "calibration")
            calibration = calibrate(network, batches, tell=lambda done: say(f"{done}"))
        print(f"Calibration: {write_calibration(calibration, path)}", file=sys.stderr)

    def _batches(self, network: "EgoVM", count: int, split: "Split") -> "EvaluationBatches":
        from egovm.dataset import NOISES, EvaluationBatches
        from egovm.made_samples import Recipe

        return EvaluationBatches(
            Recipe(), network.config, NOISES[self.noise], count, split, self.seed, self.samples, self.map
        )


@contextmanager
def _steps(total: int | None = None) -> Iterator[Callable[[dict[str, Any]], None]]:
    """A bar of steps with the errors of late on a terminal; a line every hundred steps else."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    late: dict[str, float] = {}
    columns = (BarColumn(20), TextColumn("{task.fields[text]}"), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=total, text="")

        def tell(entry: dict[str, Any]) -> None:
            for name in ("lon_m", "lat_m", "yaw_deg", "step_s"):
                late[name] = 0.95 * late.get(name, entry[name]) + 0.05 * entry[name]
            step = entry["step"] + 1
            text = (
                f"step {step}: {late['lon_m']:.3f} m, {late['lat_m']:.3f} m, {late['yaw_deg']:.3f} deg"
                f", {late['step_s']:.2f} s/step"
            )
            bar.update(task, completed=step, text=text)
            if not console.is_terminal and step % 100 == 0:
                console.print(text)

        yield tell
