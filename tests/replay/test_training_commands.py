"""egoloc train and eval, run as a user runs them."""

import json
import shutil
from pathlib import Path

import msgspec
import pytest

from egovm.config_file import config_toml
from egovm.made_samples import Recipe, Split, made_sample, recipe_name
from egovm.sample import save_sample
from egovm.weights import weights_path
from replay.cli import main
from tests.egovm.made_training import RECIPE, TRAINING


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
    assert report["calibration"] is None
    assert [level["step_m"] for level in report["covariance"]] == [0.5, 0.25, 0.125]
    assert main(judge) == 0
    printed = capsys.readouterr().out
    assert "initial pose" in printed
    assert "NEES/3" in printed
    assert "These weights have no calibration: --calibrate fits one." in printed

    # what is there already stays
    assert main(arguments) == 2
    assert "--resume goes on with it" in capsys.readouterr().err


@pytest.mark.slow
def test_calibrate_writes_a_file_that_eval_then_uses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    weights, samples = tmp_path / "mine.safetensors", tmp_path / "samples"
    for suffix in (".safetensors", ".toml"):
        shutil.copy(weights_path("small-lidar").with_suffix(suffix), weights.with_suffix(suffix))
    fill(samples, {"calibration": 40, "held-out": 3})
    judge = ["eval", str(weights), "--frames", "3", "--samples", str(samples)]
    assert main([*judge, "--json"]) == 0
    before = json.loads(capsys.readouterr().out)
    assert before["calibration"] is None
    assert [level["calibrated"] for level in before["covariance"]] == [None] * 3

    assert main([*judge, "--json", "--calibrate", "40"]) == 0
    told = capsys.readouterr()
    path = tmp_path / "mine-calibration.toml"
    assert f"Calibration: {path}" in told.err
    after = json.loads(told.out)
    assert after["calibration"]["frames"] == 40
    assert after["calibration"]["used"][0] == 40
    assert after["methods"] == before["methods"]
    for level, old in zip(after["covariance"], before["covariance"], strict=True):
        assert level["raw"] == old["raw"]
        assert level["calibrated"]["mean_by_3"] != level["raw"]["mean_by_3"]
    written = path.read_bytes()

    assert main([*judge, "--map", "lines"]) == 0
    assert "Calibrated on 40 frames" in capsys.readouterr().out
    assert main([*judge, "--calibrate", "5"]) == 2
    assert "--calibrate: expected 20 frames or more, got 5" in capsys.readouterr().err
    assert path.read_bytes() == written

    path.write_text(path.read_text().replace('weights_sha256 = "', 'weights_sha256 = "0'))
    assert main(judge) == 2
    assert "--calibrate fits anew" in capsys.readouterr().err


def fill(samples: Path, counts: dict[Split, int]) -> None:
    """Keep one sample under the first numbers of splits: what is judged does not matter here, and time does."""
    sample = made_sample(RECIPE, "calibration", 0)
    for split, count in counts.items():
        folder = samples / recipe_name(Recipe()) / split
        folder.mkdir(parents=True)
        for number in range(count):
            save_sample(sample, folder / f"{number:06d}.npz")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("train", "nowhere.toml"), "nowhere.toml: expected a training's config or one of small-lidar, found no file"),
        (("train", "small-lidar", "--steps", "0"), "--steps, --seed: expected 1 or more"),
        (("train", "small-lidar", "--ablation", "A9"), "ablation: expected one of A1"),
        (("train", "nowhere", "--resume"), "expected a training's config, found no file"),
        (("train", "nowhere", "--resume", "--seed", "3"), "--seed: expected none with --resume"),
        (("eval", "nowhere.safetensors"), "expected the network's config, found no file"),
        (("eval", "small-lidar", "--calibrate", "3"), "--calibrate: expected 20 frames or more, got 3"),
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
