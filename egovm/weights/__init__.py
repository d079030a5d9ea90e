"""Weights of a network: a safetensors file, and beside it the config that they belong to, as TOML.

Beside this module lie the weights that come with egoloc; README.md is their card.
"""

from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from egovm.config import NetworkConfig
from egovm.config_file import config_toml, read_toml
from sensors.errors import EgolocError
from sensors.whole_file import whole_file

HERE = Path(__file__).parent


def weights_path(given: str) -> Path:
    """Weights that come with egoloc, by their name, or a file."""
    own = HERE / f"{given}.safetensors"
    return own if own.is_file() else Path(given)


def save_weights(network: nn.Module, config: NetworkConfig, path: Path) -> None:
    """Write path (.safetensors) and the config beside it (.toml), each under its name only once it is complete."""
    _check_name(path)
    state = {name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()}
    with whole_file(path.with_suffix(".toml")) as part:
        part.write_text(config_toml(config))
    with whole_file(path, SafetensorError) as part:
        save_file(state, part)


def read_config(path: Path) -> NetworkConfig:
    """The config that lies beside weights, or a config file itself (.toml)."""
    if path.suffix != ".toml":
        _check_name(path)
    return read_toml(path.with_suffix(".toml"), NetworkConfig, "the network's config")


def load_weights(network: nn.Module, path: Path) -> None:
    """Put weights into a network of the same config. Raises EgolocError where names or shapes differ."""
    _check_name(path)
    if not path.is_file():
        raise EgolocError(f"{path}: expected weights of a network, found no file")
    try:
        given = load_file(path)
    except (SafetensorError, OSError) as error:
        raise EgolocError(f"{path}: expected a safetensors file: {error}") from None
    _check_state(path, given, network.state_dict())
    network.load_state_dict(given)


def _check_name(path: Path) -> None:
    if path.suffix != ".safetensors":
        raise EgolocError(f"{path}: expected a name that ends in .safetensors")


def _check_state(path: Path, given: dict[str, Tensor], wanted: dict[str, Tensor]) -> None:
    """Raise for the first weight that is missing, unknown or of another shape."""
    for name in sorted(given.keys() ^ wanted.keys()):
        raise EgolocError(f"{path}: {name}: " + ("not in this network" if name in given else "expected, found none"))
    for name, value in given.items():
        if value.shape != wanted[name].shape:
            shape = tuple(wanted[name].shape)
            raise EgolocError(f"{path}: {name}: expected shape {shape}, got {tuple(value.shape)}")
