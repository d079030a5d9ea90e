"""JSON of maps: size, depth, encoding, and a file that is not there."""

from pathlib import Path
from typing import Any

import pytest

from sensors.errors import EgolocError
from sensors.maps.json_text import read_json


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"[" * 2_000_000, "expected JSON"),
        (b'{"a": "\xff"}', "expected JSON"),
        (b"", "expected JSON"),
        (b"[1, 2]" + b" " * (2 << 20), "expected at most 2 MB of JSON"),
    ],
)
def test_no_json_is_one_line(tmp_path: Path, text: bytes, message: str) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(text)
    with pytest.raises(EgolocError, match=message) as caught:
        read_json(path, dict[str, Any] if text[:1] == b"{" else list[Any], max_bytes=2 << 20)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(EgolocError, match="cannot be read: No such file"):
        read_json(tmp_path / "a.json", dict[str, Any])
