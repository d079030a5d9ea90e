"""egoloc export: EgoVM for runtimes other than PyTorch."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from replay.commands.map_files import check_new
from replay.commands.output import print_json, stage
from sensors.errors import EgolocError


@dataclass(frozen=True)
class Export:
    """Write weights of EgoVM as ONNX: sensors and map in, pose out, one frame at a time.

    The file is compared with PyTorch in onnxruntime before it gets its name. Needs pip install egoloc[export].
    """

    weights: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="WEIGHTS")]
    """small-lidar (comes with egoloc), or a .safetensors file with its .toml beside it."""
    target: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DEST.onnx")]
    """The file to write; it must not exist yet."""
    mode: Annotated[
        Literal["full", "visual", "lidar"] | None,
        tyro.conf.arg(metavar="MODE", help_behavior_hint="(default: all that the network has)"),
    ] = None
    """What it sees by: full (cameras and LiDAR), visual or lidar; the inputs of the file are of that mode."""
    overwrite: bool = False
    """Replace DEST."""
    json: bool = False
    """Print JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Export, compare, and say how far the answers differ."""
        from egovm.calibration import calibration_path, read_calibration
        from egovm.export import check_installed, write_onnx

        check_installed()
        if self.target.suffix != ".onnx":
            raise EgolocError(f"{self.target}: expected a name that ends in .onnx")

        from egovm.convolutions import deployed
        from egovm.export_check import check_differences, differences
        from egovm.export_graph import chosen_mode
        from egovm.export_sample import sample_frames
        from egovm.network import EgoVM
        from egovm.weights import load_weights, read_config, weights_path
        from sensors.whole_file import whole_file

        path = weights_path(self.weights)
        check_new(self.target, [path], overwrite=self.overwrite)
        if not self.target.parent.is_dir():
            raise EgolocError(f"{self.target.parent}: expected a folder to write into, found none")
        config = read_config(path)
        mode = chosen_mode(config, self.mode)
        trained = EgoVM(config)
        load_weights(trained, path)
        notes = {"weights": path.name}
        if read_calibration(path, config.solver.lattice).fit is not None:
            notes["calibration"] = calibration_path(path).read_text()
        network = deployed(trained)
        with stage(f"exporting {path.name}, {mode}") as say:
            frames = list(sample_frames(config, mode))
            with whole_file(self.target) as partial:
                write_onnx(network, config, mode, frames[0][1], partial, notes)
                say("comparing")
                found = differences(network, partial, frames)
                check_differences(found, self.target)
        self._tell(mode, found)

    def _tell(self, mode: str, found: dict[str, dict[str, float]]) -> None:
        size = self.target.stat().st_size
        if self.json:
            print_json({"file": str(self.target), "mode": mode, "bytes": size, "differences": found})
            return
        from rich.table import Table

        from replay.table import output_console

        table = Table("onnxruntime - PyTorch, most", *found)
        for name in next(iter(found.values())):
            table.add_row(name, *(f"{frame[name]:.1e}" for frame in found.values()))
        output_console().print(table)
        print(f"ONNX, {mode}, {size / 1e6:.1f} MB: {self.target}")
