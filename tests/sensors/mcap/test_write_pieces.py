"""Logs that are written piece by piece: the same file as whole, valid for other readers, whole or not at all."""

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from sensors.errors import EgolocError
from sensors.geodesy import MapFrame
from sensors.mcap.io import read_log, read_pieces, write_log
from sensors.pieces import SENSORS, cut
from sensors.records import Imu, Log, Tags
from tests.sensors.mcap.messages import START_NS, full_log


def long_log() -> Log:
    """A minute with every record; tags of a few texts; pose fixes from 20 s on."""
    log = full_log(6000)
    t_ns = START_NS + np.arange(60, dtype=np.int64) * 10**9
    text = np.array(["canyon", "canyon,night", "open", ""])[np.arange(60) % 4]
    assert log.pose_fixes is not None
    mode = Tags(t_ns[:1], t_ns[:1], np.array(["autonomous"]))
    return replace(log, scene=Tags(t_ns, t_ns, text), mode=mode, pose_fixes=log.pose_fixes[200:])


@pytest.mark.parametrize("length_s", [0.5, 7.0, 100.0])
def test_the_file_does_not_depend_on_how_the_log_is_cut(tmp_path: Path, length_s: float) -> None:
    log = long_log()
    write_log(tmp_path / "whole.mcap", log)
    write_log(tmp_path / "cut.mcap", cut(log, length_s))
    assert (tmp_path / "cut.mcap").read_bytes() == (tmp_path / "whole.mcap").read_bytes()
    write_log(tmp_path / "again.mcap", read_pieces(tmp_path / "cut.mcap", length_s=length_s))
    once = read_log(tmp_path / "whole.mcap")
    twice = read_log(tmp_path / "again.mcap")
    for name in SENSORS:
        np.testing.assert_array_equal(getattr(once, name).t_ns, getattr(twice, name).t_ns)
        np.testing.assert_array_equal(getattr(once, name).arrival_ns, getattr(twice, name).arrival_ns)


def test_other_readers_find_every_message_by_every_index(tmp_path: Path) -> None:
    log = long_log()
    write_log(tmp_path / "a.mcap", cut(log, 3.0))
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        in_file = [(m.log_time, c.topic, m.sequence) for _, c, m in reader.iter_messages(log_time_order=False)]
        by_index = [(m.log_time, c.topic, m.sequence) for _, c, m in reader.iter_messages()]
        half = START_NS + 30 * 10**9
        late = [m.log_time for _, _, m in reader.iter_messages(topics=["/egovm/pose"], starting_at=half)]
    assert [time for time, _, _ in in_file] == sorted(time for time, _, _ in in_file)
    assert sorted(in_file) == sorted(by_index)
    for topic in {topic for _, topic, _ in in_file}:
        assert [n for _, name, n in in_file if name == topic] == list(range(sum(t == topic for _, t, _ in in_file)))
    assert log.pose_fixes is not None
    assert late == log.pose_fixes.arrival_ns[log.pose_fixes.arrival_ns >= half].tolist()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(in_file) == sum(len(getattr(log, name)) for name in SENSORS)
    assert summary.statistics.message_start_time == min(in_file)[0]
    assert summary.statistics.message_end_time == max(in_file)[0]
    assert summary.statistics.chunk_count == len(summary.chunk_indexes)
    counts = {summary.channels[c].topic: n for c, n in summary.statistics.channel_message_counts.items()}
    assert counts == {topic: sum(t == topic for _, t, _ in in_file) for topic in counts}


def test_messages_that_arrive_in_a_later_piece_are_held_back(tmp_path: Path) -> None:
    log = long_log()
    assert log.gnss is not None
    arrival = log.gnss.arrival_ns.copy()
    arrival[::3] += 4 * 10**9
    log = replace(log, gnss=replace(log.gnss, arrival_ns=arrival))
    write_log(tmp_path / "a.mcap", cut(log, 10.0))
    with (tmp_path / "a.mcap").open("rb") as stream:
        times = [m.log_time for _, _, m in make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False)]
    assert times == sorted(times)


def test_an_iterable_without_pieces_is_an_empty_log(tmp_path: Path) -> None:
    write_log(tmp_path / "a.mcap", iter(()))
    write_log(tmp_path / "b.mcap", Log())
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_pieces_that_end_in_an_error_leave_nothing(tmp_path: Path) -> None:
    def broken() -> Iterator[Log]:
        yield long_log()
        raise EgolocError("the road ends")

    with pytest.raises(EgolocError, match="the road ends"):
        write_log(tmp_path / "a.mcap", broken())
    assert list(tmp_path.iterdir()) == []


def test_pieces_of_different_drives_are_refused(tmp_path: Path, log: Log) -> None:
    other = replace(log, map_frame=MapFrame("enu", (49.0, 8.4, 0.0)))
    with pytest.raises(EgolocError, match=r"a\.mcap: expected the same vehicle and map frame in all pieces"):
        write_log(tmp_path / "a.mcap", [log, other])
    assert list(tmp_path.iterdir()) == []


ROUND_TRIP = """
import sys
import numpy as np
from replay.bench.memory import peak_mb
from sensors.mcap.io import describe, read_pieces, write_log
from sensors.records import Imu, Log

def pieces(count):
    rng = np.random.default_rng(1)
    for k in range(count):
        t = 1_700_000_000_000_000_000 + (k * 10_000 + np.arange(10_000, dtype=np.int64)) * 2_000_000
        yield Log(imu=Imu(t, t, rng.normal(size=(10_000, 3)), rng.normal(size=(10_000, 3))))

path, count = sys.argv[1], int(sys.argv[2])
write_log(path, pieces(count), "lz4")
assert sum(len(p.imu) for p in read_pieces(path, length_s=20.0)) == 10_000 * count
seen = []
assert describe(path, visit=lambda piece: seen.append(len(piece.imu))).rows == {"imu": 10_000 * count}
print(peak_mb())
"""


def test_memory_does_not_follow_the_length(tmp_path: Path) -> None:
    """Written, read and described in pieces of 20 s (peak resident size of a process, MB): 45 and 100 of them."""

    def peak(count: int) -> float:
        run = [sys.executable, "-c", ROUND_TRIP, str(tmp_path / "a.mcap"), str(count)]
        return float(subprocess.run(run, capture_output=True, text=True, check=True).stdout)

    short, long = peak(45), peak(100)
    assert (tmp_path / "a.mcap").stat().st_size > 90e6
    assert long - short < 12  # the rows take 35 MB more, the file 52 MB


def test_a_piece_may_hold_nothing(tmp_path: Path) -> None:
    imu = Imu(np.array([START_NS]), np.array([START_NS]), np.zeros((1, 3)), np.zeros((1, 3)))
    write_log(tmp_path / "a.mcap", [Log(), Log(imu=imu), Log()])
    assert len(read_log(tmp_path / "a.mcap").imu or ()) == 1
