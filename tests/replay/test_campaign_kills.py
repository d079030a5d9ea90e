"""Processes of a campaign killed at any moment: nothing is lost, nothing is counted twice."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from replay.cli import main
from tests.replay.fleet import PATIENCE_S, alive, content, kill, start, tiny, wait_until, workers

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")

DRIVES = 6
Begin = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> str:
    return tiny(tmp_path_factory.mktemp("scenario"), DRIVES)


@pytest.fixture(scope="module")
def command(logs: str) -> tuple[str, ...]:
    return ("replay", logs, "--out", "run", "--workers", "2")


@pytest.fixture
def begin(tmp_path: Path) -> Iterator["Begin"]:
    """Starts egoloc in the test's folder; what still runs at the end of the test is killed."""
    processes: list[subprocess.Popen[str]] = []

    def run(*arguments: str) -> "subprocess.Popen[str]":
        processes.append(start(*arguments, cwd=tmp_path))
        return processes[-1]

    yield run
    for process in processes:
        process.kill()
        process.communicate()


@pytest.fixture(scope="module")
def in_process(logs: str, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What a campaign writes without any worker. It comes first: kernels are compiled by then."""
    out = tmp_path_factory.mktemp("one") / "run"
    assert main(["replay", logs, "--out", str(out), "--workers", "1"]) == 0
    return content(out)


@pytest.fixture(scope="module")
def unbroken(
    command: tuple[str, ...], in_process: dict[str, bytes], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, bytes]:
    """What a campaign writes that nothing disturbs."""
    folder = tmp_path_factory.mktemp("unbroken")
    process = start(*command, cwd=folder)
    _, error = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, error
    assert error.startswith(f"Replayed {DRIVES} of {DRIVES} logs: ")
    return content(folder / "run", command=True)


def test_two_workers_write_what_one_process_writes(in_process: dict[str, bytes], unbroken: dict[str, bytes]) -> None:
    assert in_process.keys() == unbroken.keys()
    other = [name for name, found in in_process.items() if found != unbroken[name]]
    assert [name for name in other if not name.endswith("manifest.json")] == []  # these hold the command


def test_a_killed_worker_costs_nothing(
    begin: Begin, command: tuple[str, ...], unbroken: dict[str, bytes], tmp_path: Path
) -> None:
    process = begin(*command)
    for finished in (0, 2):
        wait_until(lambda least=finished: begun(tmp_path / "run") and len(done(tmp_path / "run")) >= least)  # type: ignore[misc]
        kill(workers(process.pid)[0])
    _, error = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, error
    assert content(tmp_path / "run", command=True) == unbroken


def begun(run: Path) -> list[Path]:
    """Run folders in the making."""
    return list(run.glob(".tiny-*.tmp"))


def done(run: Path) -> list[str]:
    """Logs whose run folders are there."""
    return sorted(path.name for path in run.glob("tiny-*") if path.is_dir())


MOMENTS: dict[str, Callable[[Path], bool]] = {
    "at the start": lambda run: (run / "config.toml").exists(),
    "while the first logs are written": lambda run: bool(begun(run)),
    "between logs": lambda run: len(done(run)) >= 3,
    "near the end": lambda run: len(done(run)) >= DRIVES - 1,
}


QUICK = "between logs"
"""The moment that is tried in every run of the tests."""


@pytest.mark.parametrize(
    "moment", [name if name == QUICK else pytest.param(name, marks=pytest.mark.slow) for name in MOMENTS]
)
def test_a_killed_campaign_resumes_to_the_same_bytes(
    moment: str, begin: Begin, command: tuple[str, ...], unbroken: dict[str, bytes], tmp_path: Path
) -> None:
    process = begin(*command)
    wait_until(lambda: MOMENTS[moment](tmp_path / "run"))
    orphans = workers(process.pid)
    kill(process.pid)
    process.communicate(timeout=PATIENCE_S)
    wait_until(lambda: not any(map(alive, orphans)))
    assert not (tmp_path / "run/metrics.json").exists()
    again = begin(*command, "--resume")
    _, error = again.communicate(timeout=PATIENCE_S)
    assert again.returncode == 0, error
    assert content(tmp_path / "run", command=True) == unbroken


KILLED_WHILE_MERGING = """
import os, signal
import replay.campaign
replay.campaign.write_json = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
from replay.cli import main
main()
"""


def test_killed_while_merging(
    begin: Begin, command: tuple[str, ...], unbroken: dict[str, bytes], tmp_path: Path
) -> None:
    """Before metrics.json is written, when the other files of the campaign are there."""
    killed = [sys.executable, "-c", KILLED_WHILE_MERGING, *command]
    assert subprocess.run(killed, cwd=tmp_path, check=False, timeout=PATIENCE_S).returncode == -signal.SIGKILL
    assert len(done(tmp_path / "run")) == DRIVES
    assert not (tmp_path / "run/metrics.json").exists()
    again = begin(*command, "--resume")
    _, error = again.communicate(timeout=PATIENCE_S)
    assert (again.returncode, error) == (0, "")  # nothing was replayed
    assert content(tmp_path / "run", command=True) == unbroken


def test_ctrl_c_ends_all_and_leaves_what_is_finished(begin: Begin, command: tuple[str, ...], tmp_path: Path) -> None:
    many = (word.replace(f"drives={DRIVES}", "drives=60") for word in command)  # a busy machine is slow to interrupt
    process = begin(*many)
    wait_until(lambda: len(done(tmp_path / "run")) >= 1)
    orphans = workers(process.pid)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: every process of the group
    _, error = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    counted, said = error.splitlines()
    assert counted.startswith("Replayed ")
    assert said == "egoloc: interrupted: the same command with --resume goes on"
    assert not any(map(alive, orphans))
    left = {path.name for path in (tmp_path / "run").iterdir()}
    assert left == {"config.toml", "manifest.json", *done(tmp_path / "run")}


@pytest.mark.slow
def test_a_log_that_kills_its_workers_is_told(
    begin: Begin, command: tuple[str, ...], unbroken: dict[str, bytes], tmp_path: Path
) -> None:
    process = begin(*command)
    run, deaths = tmp_path / "run", 0
    while process.poll() is None:
        for path in run.glob(".tiny-000003.*.tmp"):  # named after the process that writes it
            worker = int(path.name.split(".")[2])
            if worker in workers(process.pid):
                kill(worker)
                wait_until(lambda pid=worker: not alive(pid))  # type: ignore[misc]
                deaths += 1
    _, error = process.communicate()
    assert (process.returncode, deaths) == (1, 3), error
    assert "its worker died 3 times (SIGKILL: out of memory?)" in error
    assert "its worker died 3 times" in (run / "tiny-000003.error.txt").read_text()
    assert len(done(run)) == DRIVES - 1
    again = begin(*command, "--resume")
    _, error = again.communicate(timeout=PATIENCE_S)
    assert error.startswith("Replayed 1 of 1 logs")
    assert content(run, command=True) == unbroken
