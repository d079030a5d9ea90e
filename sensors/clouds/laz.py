"""Whether the compressed points of a LAZ file can be what they claim: lazrs takes every size in them as it is.

Points of format 6 and above lie in chunks, each of one whole point, the number of points, the sizes of its layers, and
the layers. Source: Isenburg, "LASzip" (2013), and the LAZ specification (rapidlasso).
"""

import os
import struct
from pathlib import Path
from typing import BinaryIO

import laspy
import lazrs

from sensors.errors import EgolocError

_LAYERS = 9
"""Of every point; colour and infrared add one each, and so does every extra byte."""
_COLOURS = {7: 1, 8: 2}


def check_chunks(path: Path, header: laspy.LasHeader) -> None:
    """EgolocError where chunks or their layers claim more bytes than the file has. The header is that of a LAZ file."""
    records = header.vlrs.get("LasZipVlr")
    if not records:
        raise EgolocError(f"{path}: expected a record of the LAZ compressor, found none")
    with path.open("rb") as stream:
        _check_count(path, stream, header)
        stream.seek(header.offset_to_point_data)
        chunks = lazrs.read_chunk_table(stream, lazrs.LazVlr(records[0].record_data))
        size, at = os.fstat(stream.fileno()).st_size, header.offset_to_point_data + 8
        for number, (_, length) in enumerate(chunks):
            if length > size - at:
                raise EgolocError(f"{path}: chunk {number}: claims {length} bytes, the file has {size - at}")
            if header.point_format.id >= 6:
                _check_layers(path, stream, header, number, at, length)
            at += length


def _check_count(path: Path, stream: BinaryIO, header: laspy.LasHeader) -> None:
    """That there are no more chunks than points; the table's place stands in front of the points or at the end."""
    size = os.fstat(stream.fileno()).st_size
    stream.seek(header.offset_to_point_data)
    (table,) = struct.unpack("<q", stream.read(8))
    if table == -1:
        stream.seek(max(size - 8, 0))
        (table,) = struct.unpack("<q", stream.read(8))
    if not 0 < table <= size - 8:
        raise EgolocError(f"{path}: chunk table: expected it in the file's {size} bytes, got byte {table}")
    stream.seek(table + 4)
    (count,) = struct.unpack("<I", stream.read(4))
    if count > header.point_count:
        raise EgolocError(f"{path}: chunk table: {count} chunks for {header.point_count} points")


def _check_layers(path: Path, stream: BinaryIO, header: laspy.LasHeader, number: int, at: int, length: int) -> None:
    """That a chunk's layers fit into it."""
    kind = header.point_format
    layers = _LAYERS + _COLOURS.get(kind.id, 0) + (kind.num_extra_bytes if kind.id in {6, 7, 8} else 0)
    head = kind.size + 4 + 4 * layers
    stream.seek(at + kind.size + 4)
    words = stream.read(4 * layers)
    if head > length or len(words) < 4 * layers or head + sum(struct.unpack(f"<{layers}I", words)) > length:
        raise EgolocError(f"{path}: chunk {number}: its layers claim more than its {length} bytes")
