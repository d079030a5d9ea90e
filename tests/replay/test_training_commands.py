"""egoloc train and eval, run as a user runs them."""

import json
import shutil
from pathlib import Path

import msgspec
import pytest

from egovm.config_file import config_toml
from replay.cli import main
from tests.egovm.made_training import TRAINING


def test_train_resume_and_eval(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config, run, samples = tmp_path / "tiny.toml", tmp_path / "run", str(tmp_path / "samples")
    config.write_text(config_toml(TRAINING))
    arguments = ["train", str(config), "--out", str(run), "--steps", "3", "--samples", samples]
    assert main(arguments) == 0
    assert f"Weights: {run / 'weights.safetensors'}" in capsys.readouterr().out
    assert len((run / "log.jsonl").read_text().splitlines()) == 3

    assert main(["train", str(run), "--resume", "--samples", samples]) == 0
    assert len((run / "log.jsonl").read_text().splitlines()) == 3
    capsys.readouterr()

    judge = ["eval", str(run / "weights.safetensors"), "--frames", "3", "--noise", "gauss", "--samples", samples]
    assert main([*judge, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["frames"] == 3
    assert report["noise"] == "gauss"
    assert set(report["methods"]) == {"initial", "egovm"}
    assert report["methods"]["initial"]["lon"]["mae"] > 0.0
    assert main(judge) == 0
    printed = capsys.readouterr().out
    assert "initial pose" in printed
    assert "NEES/3" in printed

    # what is there already stays
    assert main(arguments) == 2
    assert "--resume goes on with it" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("train", "nowhere.toml"), "nowhere.toml: expected a training's config or one of small-lidar, found no file"),
        (("train", "small-lidar", "--steps", "0"), "--steps, --seed: expected 1 or more"),
        (("train", "small-lidar", "--ablation", "A9"), "ablation: expected one of A1"),
        (("train", "nowhere", "--resume"), "expected a training's config, found no file"),
        (("train", "nowhere", "--resume", "--seed", "3"), "--seed: expected none with --resume"),
        (("eval", "nowhere.safetensors"), "expected the network's config, found no file"),
        (("eval", "small-lidar", "--frames", "0"), "--frames, --seed: expected 1 or more"),
    ],
)
def test_mistakes_are_told_in_a_line(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    arguments: tuple[str, ...],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    told = capsys.readouterr().err
    assert message in told
    assert told.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_weights_without_their_config_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.toml").write_text(config_toml(msgspec.structs.replace(TRAINING.built())))
    assert main(["eval", str(tmp_path / "a.safetensors")]) == 2
    assert "expected weights of a network, found no file" in capsys.readouterr().err
    shutil.copy(tmp_path / "a.toml", tmp_path / "b.toml")
    (tmp_path / "b.safetensors").write_bytes(b"no weights")
    assert main(["eval", str(tmp_path / "b.safetensors")]) == 2
    assert "expected a safetensors file" in capsys.readouterr().err
