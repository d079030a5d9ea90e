"""Campaigns on a Ray cluster of two nodes on this machine: the same bytes, also when a node is lost."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from replay.cli import main
from tests.replay.fleet import PATIENCE_S, content, start, tiny, wait_until

ray = pytest.importorskip("ray")
DRIVES = 6


@pytest.fixture
def cluster() -> Iterator[Any]:
    """A head that takes no work and two nodes of one core each."""
    from ray.cluster_utils import Cluster

    small = {"object_store_memory": 100_000_000}
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False, **small})
    try:
        cluster.nodes = [cluster.add_node(num_cpus=1, **small) for _ in range(2)]
        cluster.wait_for_nodes()
        yield cluster
    finally:
        ray.shutdown()
        cluster.shutdown()


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> str:
    return tiny(tmp_path_factory.mktemp("scenario"), DRIVES)


@pytest.fixture(scope="module")
def campaign(logs: str, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What one process writes."""
    out = tmp_path_factory.mktemp("campaign") / "run"
    assert main(["replay", logs, "--out", str(out), "--workers", "1"]) == 0
    return content(out)


def test_two_nodes_write_what_one_process_writes(
    cluster: Any,
    logs: str,
    campaign: dict[str, bytes],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.mcap").write_bytes(b"no log")
    capfd.readouterr()
    assert main(["replay", logs, "--out", "run", "--ray", cluster.address]) == 0
    said = capfd.readouterr()
    assert said.err.startswith(f"Replayed {DRIVES} of {DRIVES} logs: ")
    assert said.err.count("\n") == 1  # nothing of Ray's own
    assert content(tmp_path / "run") == campaign
    assert main(["replay", logs, "bad.mcap", "--out", "two", "--ray", cluster.address]) == 1
    assert "1 of 7 logs failed" in capfd.readouterr().err
    assert "bad.mcap: " in (tmp_path / "two/bad.error.txt").read_text()
    one = f"{logs.partition(',')[0]},seed=1"
    assert main(["replay", one, "--out", "one", "--ray", cluster.address]) == 0
    assert content(tmp_path / "one")["metrics.json"] == campaign["tiny-000001/metrics.json"]


@pytest.mark.slow
def test_a_lost_node_costs_nothing(cluster: Any, logs: str, campaign: dict[str, bytes], tmp_path: Path) -> None:
    many = f"{logs.partition(',')[0]},drives=40"
    process = start("replay", many, "--out", "run", "--ray", cluster.address, "--json", cwd=tmp_path)
    wait_until(lambda: len(list((tmp_path / "run").glob("tiny-*"))) >= 4 or process.poll() is not None)
    cluster.remove_node(cluster.nodes[1], allow_graceful=False)
    printed, error = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, error
    assert error.startswith("Replayed 40 of 40 logs: ")
    assert json.loads(printed)["logs"] == {"total": 40, "done": 40, "failed": []}  # and nothing of Ray's own
    found = content(tmp_path / "run")
    logs_of_one = {name: data for name, data in campaign.items() if name.startswith("tiny-")}
    assert {name: found[name] for name in logs_of_one} == logs_of_one
    assert main(["replay", many, "--out", str(tmp_path / "here"), "--workers", "2"]) == 0
    assert found == content(tmp_path / "here")


MISTAKES = {
    "nowhere": "--ray: expected HOST:PORT of a Ray cluster, auto or local, got 'nowhere'",
    "": "--ray: expected HOST:PORT of a Ray cluster, auto or local, got ''",
    "ray://127.0.0.1:10001": "--ray: expected HOST:PORT of a Ray cluster, auto or local, got 'ray://127.0.0.1:10001'",
    "127.0.0.1:1": "--ray 127.0.0.1:1: nothing answers there, expected a Ray cluster: Connection refused",
}


@pytest.mark.parametrize("address", MISTAKES)
def test_an_address_without_a_cluster_costs_nothing(
    address: str, logs: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Least of all the campaign that was to be replaced."""
    (tmp_path / "run").mkdir()
    (tmp_path / "run/manifest.json").write_text('{"kind": "campaign", "logs": []}')
    (tmp_path / "run/metrics.json").write_text("{}")
    before = content(tmp_path / "run", command=True)
    assert main(["replay", logs, "--out", str(tmp_path / "run"), "--ray", address, "--overwrite"]) == 2
    assert capsys.readouterr().err == f"egoloc: error: {MISTAKES[address]}\n"
    assert content(tmp_path / "run", command=True) == before
    assert main(["replay", f"{logs},seed=1", "--out", str(tmp_path / "new"), "--ray", address]) == 2
    assert main(["replay", "scenario:clean", "--out", str(tmp_path / "one"), "--ray", address]) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_without_ray(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    assert main(["replay", "scenario:clean", "--out", str(tmp_path / "run"), "--ray", "local"]) == 2
    assert 'pip install "egoloc[ray]"' in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
