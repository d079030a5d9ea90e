"""Training: steps of AdamW, a log of each, and checkpoints from which it goes on bit by bit as if never stopped.

A step's batch and random numbers are of the training's seed and the step's number alone, so a checkpoint need not hold
any generator. It is written under another name and renamed; a kill loses what was learned since.
"""

import json
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from egovm.batch import Batch, Truth
from egovm.config_file import config_toml, read_toml
from egovm.dataset import TrainingBatches, loader
from egovm.judging import judged
from egovm.losses import network_losses
from egovm.network import EgoVM
from egovm.train_config import TrainConfig
from egovm.weights import save_weights
from sensors.errors import EgolocError
from sensors.whole_file import whole_file

CONFIG, LOG, CHECKPOINT, WEIGHTS = "config.toml", "log.jsonl", "checkpoint.pt", "weights.safetensors"
Entry = dict[str, Any]


@dataclass(slots=True)
class Training:
    """What changes: step, the next one; seconds, spent on those before."""

    config: TrainConfig
    network: EgoVM
    optimizer: torch.optim.Optimizer
    step: int = 0
    seconds: float = 0.0


def train(config: TrainConfig, folder: Path, cache: Path, tell: Callable[[Entry], None] = lambda _: None) -> Path:
    """Train in a new folder; returns the weights. cache: folder in which made samples are kept; tell: each log entry.

    Raises EgolocError where the folder holds a training already.
    """
    if (folder / CONFIG).exists():
        raise EgolocError(f"{folder}: expected a new folder, found a training: --resume goes on with it")
    folder.mkdir(parents=True, exist_ok=True)
    with whole_file(folder / CONFIG) as part:
        part.write_text(config_toml(config))
    return _run(begun(config), folder, cache, tell)


def resume(folder: Path, cache: Path, tell: Callable[[Entry], None] = lambda _: None) -> Path:
    """Go on with the training of a folder from its last checkpoint; returns the weights."""
    training = begun(read_toml(folder / CONFIG, TrainConfig, "a training's config"))
    if (folder / CHECKPOINT).exists():
        _restore(training, folder / CHECKPOINT)
    _cut_log(folder / LOG, training.step)
    return _run(training, folder, cache, tell)


def begun(config: TrainConfig) -> Training:
    """A network of the training's seed that has learned nothing yet."""
    torch.manual_seed(config.seed)
    network: EgoVM = EgoVM(config.built()).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return Training(config, network, _optimizer(config, network))


def learn(training: Training, batch: Batch, truth: Truth) -> Entry:
    """One step; what it was like. A step whose gradient is not finite changes nothing, and says so."""
    begin = time.perf_counter()
    config, network = training.config, training.network
    torch.manual_seed(_seed_of(training))
    network.train()
    output = network(batch)
    estimate = output.estimate
    losses = network_losses(
        config.loss,
        network.config.ablation,
        truth,
        estimate.offset if network.solver is None else estimate,
        network.solver,
        output.logits,
        torch.Generator().manual_seed(_seed_of(training)),
    )
    rate = learning_rate(config, training.step)
    for group in training.optimizer.param_groups:
        group["lr"] = rate * group["share"]
    training.optimizer.zero_grad()
    losses.total.backward()  # type: ignore[no-untyped-call]
    norm = float(nn.utils.clip_grad_norm_(network.parameters(), config.clip))
    if math.isfinite(norm):
        training.optimizer.step()
    entry = {
        "step": training.step,
        **{name: _number(getattr(losses, name)) for name in ("total", "rmse", "solver", "random_pose", "semantic")},
        **_errors(output.estimate, truth),
        "learning_rate": rate,
        "gradient": norm if math.isfinite(norm) else None,
        "step_s": time.perf_counter() - begin,
    }
    training.step += 1
    return entry


def learning_rate(config: TrainConfig, step: int) -> float:
    """Rising in the warm-up, then half a cosine down to nearly zero."""
    if step < config.warm_up:
        return config.learning_rate * (step + 1) / config.warm_up
    part = (step - config.warm_up) / max(config.steps - config.warm_up, 1)
    return config.learning_rate * 0.5 * (1.0 + math.cos(math.pi * part))


def _optimizer(config: TrainConfig, network: EgoVM) -> torch.optim.Optimizer:
    """AdamW, slower for the image backbone."""
    camera = network.bev.camera
    slow = {id(p) for p in camera.parameters()} if camera is not None else set()
    groups = [([p for p in network.parameters() if id(p) not in slow], 1.0)]
    if camera is not None:
        groups.append((list(camera.parameters()), config.backbone_rate))
    rated = [{"params": params, "share": share} for params, share in groups]
    return torch.optim.AdamW(rated, config.learning_rate, weight_decay=config.weight_decay)


def _run(training: Training, folder: Path, cache: Path, tell: Callable[[Entry], None]) -> Path:
    config = training.config
    torch.set_num_threads(config.threads or len(os.sched_getaffinity(0)))
    batches = TrainingBatches(
        config.recipe, config.built(), config.noise, config.augmentation, config.batch, config.seed, cache
    )
    saved = clock = time.monotonic()
    with (folder / LOG).open("a") as log:
        for batch, truth in loader(batches, range(training.step, config.steps), config.workers):
            entry = learn(training, batch, truth)
            training.seconds += time.monotonic() - clock
            clock = time.monotonic()
            entry["trained_s"] = training.seconds
            log.write(json.dumps(entry) + "\n")
            tell(entry)
            if clock - saved >= config.checkpoint_s:
                log.flush()
                checkpoint(training, folder / CHECKPOINT)
                saved = clock
    checkpoint(training, folder / CHECKPOINT)
    save_weights(training.network, training.network.config, folder / WEIGHTS)
    return folder / WEIGHTS


def checkpoint(training: Training, path: Path) -> None:
    """Write all that a training needs to go on."""
    held = {
        "network": training.network.state_dict(),
        "optimizer": training.optimizer.state_dict(),
        "step": training.step,
        "seconds": training.seconds,
    }
    with whole_file(path, RuntimeError) as part:  # torch's, where it cannot write
        torch.save(held, part)


def _restore(training: Training, path: Path) -> None:
    held = torch.load(path, weights_only=True)
    training.network.load_state_dict(held["network"])
    training.optimizer.load_state_dict(held["optimizer"])
    training.step, training.seconds = held["step"], held["seconds"]


def _cut_log(path: Path, step: int) -> None:
    """Leave out what was logged after the checkpoint, and a line that a kill cut off: these steps come again."""
    if not path.exists():
        return
    lines = path.read_text().splitlines(keepends=True)
    kept = [line for line in lines if line.endswith("\n") and json.loads(line)["step"] < step]
    with whole_file(path) as part:
        part.write_text("".join(kept))


def _errors(estimate: Any, truth: Truth) -> Entry:
    """Mean absolute errors of the batch."""
    errors = judged(estimate, truth.offset)
    lon, lat, yaw = errors.error.abs().mean(0).tolist()
    return {"lon_m": lon, "lat_m": lat, "yaw_deg": math.degrees(yaw)}


def _seed_of(training: Training) -> int:
    return training.config.seed * 1_000_003 + training.step


def _number(value: Tensor) -> float:
    return float(value.detach())
