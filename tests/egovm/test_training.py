"""Training: it learns, goes on bit by bit after a stop or a kill, and loses no more than it says."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch

from egovm.config_file import config_toml, read_toml
from egovm.dataset import TrainingBatches
from egovm.train import CHECKPOINT, LOG, WEIGHTS, Entry, begun, checkpoint, learn, learning_rate, resume, train
from egovm.train_config import TRAININGS, TrainConfig, read_training
from egovm.weights import load_weights, read_config
from sensors.errors import EgolocError
from tests.egovm.made_training import NETWORK, RECIPE, STILL, TRAINING, made_cache

__all__ = ["made_cache"]

ROOT = Path(__file__).parents[2]


def logged(folder: Path) -> list[Entry]:
    return [json.loads(line) for line in (folder / LOG).read_text().splitlines()]


def test_one_batch_is_learned(made_cache: Path) -> None:
    """From errors of a metre to centimetres, and to a loss that no wide posterior has."""
    config = msgspec.structs.replace(TRAINING, steps=40)
    training = begun(config)
    batches = TrainingBatches(RECIPE, NETWORK, config.noise, STILL, 2, 0, made_cache)
    batch, truth = batches[0]
    entries = [learn(training, batch, truth) for _ in range(40)]
    first, last = entries[0], entries[-5:]
    assert np.hypot(first["lon_m"], first["lat_m"]) > 0.3
    assert max(entry["lon_m"] for entry in last) < 0.1
    assert max(entry["lat_m"] for entry in last) < 0.1
    assert max(entry["yaw_deg"] for entry in last) < 0.2
    for name in ("rmse", "solver", "random_pose", "semantic"):
        assert np.mean([entry[name] for entry in last]) < 0.7 * first[name] or name == "random_pose"
    assert np.mean([entry["random_pose"] for entry in last]) < first["random_pose"] - 3.0


def test_a_resumed_training_ends_in_the_same_bits(tmp_path: Path, made_cache: Path) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    train(TRAINING, whole, made_cache)

    def stop(entry: Entry) -> None:
        if entry["step"] == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):  # every step has its checkpoint: steps 0 to 2 are kept
        train(msgspec.structs.replace(TRAINING, checkpoint_s=1e-9), parts, made_cache, stop)
    assert torch.load(parts / CHECKPOINT, weights_only=True)["step"] == 3
    resumed: list[int] = []
    resume(parts, made_cache, lambda entry: resumed.append(entry["step"]))
    assert resumed == [3, 4, 5]
    a, b = (torch.load(folder / CHECKPOINT, weights_only=True) for folder in (whole, parts))
    assert a["step"] == b["step"] == TRAINING.steps
    assert all(torch.equal(a["network"][name], b["network"][name]) for name in a["network"])
    moments = [held["optimizer"]["state"] for held in (a, b)]
    assert all(torch.equal(moments[0][i]["exp_avg_sq"], moments[1][i]["exp_avg_sq"]) for i in moments[0])
    assert (whole / WEIGHTS).read_bytes() == (parts / WEIGHTS).read_bytes()
    losses = [[(entry["step"], entry["total"]) for entry in logged(folder)] for folder in (whole, parts)]
    assert losses[0] == losses[1]


def test_a_killed_training_goes_on(tmp_path: Path, made_cache: Path) -> None:
    """A process killed between steps leaves a checkpoint that is whole; steps since come again, and count once."""
    config = msgspec.structs.replace(TRAINING, steps=4000, checkpoint_s=1e-9)
    (tmp_path / "config.toml").write_text(config_toml(config))
    code = f"from pathlib import Path; from egovm.train_config import read_training; from egovm.train import train; \
train(read_training({str(tmp_path / 'config.toml')!r}), Path({str(tmp_path / 'run')!r}), Path({str(made_cache)!r}))"
    process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)})
    try:
        until = time.monotonic() + 60.0
        while not (tmp_path / "run" / CHECKPOINT).exists():
            assert process.poll() is None
            assert time.monotonic() < until
            time.sleep(0.05)
        time.sleep(0.3)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    done = torch.load(tmp_path / "run" / CHECKPOINT, weights_only=True)["step"]
    (tmp_path / "run" / "config.toml").write_text(config_toml(msgspec.structs.replace(config, steps=done + 2)))
    resume(tmp_path / "run", made_cache)
    assert [entry["step"] for entry in logged(tmp_path / "run")] == list(range(done + 2))


def test_a_log_cut_off_within_a_line_goes_on(tmp_path: Path, made_cache: Path) -> None:
    train(msgspec.structs.replace(TRAINING, steps=2), tmp_path, made_cache)
    with (tmp_path / LOG).open("a") as log:
        log.write('{"step": 2, "total": 1.0}\n{"step": 3, "tot')
    resume(tmp_path, made_cache)
    assert [entry["step"] for entry in logged(tmp_path)] == [0, 1]


def test_weights_are_those_of_the_network(tmp_path: Path, made_cache: Path) -> None:
    config = msgspec.structs.replace(TRAINING, steps=1)
    path = train(config, tmp_path, made_cache)
    assert read_config(path) == config.built()
    network = begun(config).network
    load_weights(network, path)
    held = torch.load(tmp_path / CHECKPOINT, weights_only=True)["network"]
    assert all(torch.equal(value, held[name]) for name, value in network.state_dict().items())


def test_a_step_without_a_finite_gradient_changes_nothing(made_cache: Path) -> None:
    training = begun(TRAINING)
    assert training.network.solver is not None
    batch, truth = TrainingBatches(RECIPE, NETWORK, TRAINING.noise, STILL, 2, 0, made_cache)[0]
    weights = {name: value.detach().clone() for name, value in training.network.named_parameters()}
    hook = training.network.solver.tau.register_hook(lambda gradient: gradient * math.inf)
    entry = learn(training, batch, truth)
    assert entry["gradient"] is None
    assert training.step == 1
    assert all(torch.equal(value, weights[name]) for name, value in training.network.named_parameters())
    hook.remove()
    assert learn(training, batch, truth)["gradient"] > 0.0
    assert not torch.equal(training.network.solver.tau, weights["solver.tau"])


def test_the_learning_rate_rises_and_falls() -> None:
    config = msgspec.structs.replace(TRAINING, steps=100, warm_up=10, learning_rate=1.0)
    assert learning_rate(config, 0) == pytest.approx(0.1)
    assert learning_rate(config, 9) == pytest.approx(1.0)
    assert learning_rate(config, 55) == pytest.approx(0.5)
    assert learning_rate(config, 99) == pytest.approx(0.0, abs=1e-3)


def test_a_second_training_does_not_replace_the_first(tmp_path: Path, made_cache: Path) -> None:
    checkpoint(begun(TRAINING), tmp_path / CHECKPOINT)
    (tmp_path / "config.toml").write_text(config_toml(TRAINING))
    with pytest.raises(EgolocError, match="expected a new folder, found a training: --resume goes on with it"):
        train(TRAINING, tmp_path, made_cache)


@pytest.mark.parametrize("name", [*TRAININGS, None])
def test_configs_are_read_back(tmp_path: Path, name: str | None) -> None:
    config = TRAINING if name is None else TRAININGS[name]
    (tmp_path / "a.toml").write_text(config_toml(config))
    assert read_toml(tmp_path / "a.toml", TrainConfig, "it") == config


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("stepz = 3", "unknown field `stepz`"),
        ("steps = 0", "Expected `int` >= 1"),
        ('network = "huge"', "network: expected one of paper, small, small-lidar, got huge"),
        ('ablation = "A9"', "ablation: expected one of A1, A2, A3, A4, A5, A6, got A9"),
        ("noise = 3", "Expected `object`"),
        ("[", "a.toml"),
    ],
)
def test_mistakes_in_configs_are_told(tmp_path: Path, line: str, message: str) -> None:
    (tmp_path / "a.toml").write_text(line + "\n")
    with pytest.raises(EgolocError) as told:
        read_training(str(tmp_path / "a.toml"))
    assert message in str(told.value)
    assert "\n" not in str(told.value)


def test_a_config_that_is_not_there_is_told() -> None:
    with pytest.raises(EgolocError, match="nowhere: expected a training's config or one of small-lidar, found no file"):
        read_training("nowhere")
