"""The hardened XML reader: what it refuses, and the lines that its elements know."""

from pathlib import Path

import pytest

from sensors.errors import EgolocError
from sensors.maps import hardened_xml

BOMB = """<?xml version="1.0"?>
<!DOCTYPE lolz [
 <!ENTITY lol "lol">
 <!ENTITY lol2 "&lol;&lol;&lol;&lol;&lol;&lol;&lol;&lol;&lol;&lol;">
]>
<osm>&lol2;</osm>"""


def _written(folder: Path, text: str | bytes) -> Path:
    path = folder / "map.xml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_elements_know_their_file_and_line(tmp_path: Path) -> None:
    path = _written(tmp_path, '<a>\n <b x="1.5"/>\n <!-- c -->\n <b x="&lt;"><![CDATA[ +proj=utm ]]></b>\n</a>')
    root = hardened_xml.parse(path)
    first, second = root.findall("b")
    assert hardened_xml.number(first, "x") == 1.5
    assert hardened_xml.number(first, "y", 2.0) == 2.0
    assert (second.get("x"), second.text) == ("<", " +proj=utm ")
    assert isinstance(second, hardened_xml.Node)
    assert (root.line, second.line, second.path) == (1, 4, path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BOMB, "line 2: expected a map without document type or entities, got <!DOCTYPE"),
        ('<!DOCTYPE a SYSTEM "file:///etc/passwd"><a/>', "line 1: expected a map without document type"),
        ('<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]><a>&x;</a>', "line 1: expected a map without"),
        ("<a>\n&undefined;</a>", "line 2: expected well-formed XML: undefined entity"),
        ("<a>\n<b>\n</a>", "line 3: expected well-formed XML: mismatched tag"),
        ("", "line 1: expected well-formed XML: no element found"),
        ("Once upon a time", "line 1: expected well-formed XML: syntax error"),
        (b"\x89PNG\r\n\x00\x00", "line 1: expected well-formed XML"),
        ('<?xml version="1.0" encoding="klingon"?><a/>', "line 1: expected XML in a known encoding: unknown encoding"),
        ("<a>" * 100 + "</a>" * 100, "line 1: expected at most 64 elements inside each other"),
    ],
)
def test_a_bad_file_is_one_line_that_names_it(tmp_path: Path, text: str | bytes, message: str) -> None:
    path = _written(tmp_path, text)
    with pytest.raises(EgolocError) as raised:
        hardened_xml.parse(path)
    assert str(raised.value).startswith(f"{path}: {message}")
    assert "\n" not in str(raised.value)


def test_a_file_above_the_limit_is_not_read(tmp_path: Path) -> None:
    path = _written(tmp_path, "<a>" + " " * (3 << 20) + "</a>")
    with pytest.raises(EgolocError, match=r"map\.xml: expected at most 2 MB of XML, got 3 MB"):
        hardened_xml.parse(path, max_bytes=2 << 20)
    assert hardened_xml.parse(path).tag == "a"


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(EgolocError, match=r"nowhere\.xodr: cannot be read: No such file"):
        hardened_xml.parse(tmp_path / "nowhere.xodr")


@pytest.mark.parametrize("text", ["nan", "inf", "-1e999", "-1e13", "1,5", ""])
def test_a_number_that_is_none_is_named(tmp_path: Path, text: str) -> None:
    root = hardened_xml.parse(_written(tmp_path, f'<a>\n<b x="{text}"/></a>'))
    with pytest.raises(EgolocError, match=r"map\.xml: line 2: <b>: x: expected a finite number, got"):
        hardened_xml.number(root[0], "x")
    with pytest.raises(EgolocError, match=r"line 2: <b>: expected the attribute y"):
        hardened_xml.number(root[0], "y")
