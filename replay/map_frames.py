"""The map frame that a user asks for: as text, or that of a map or a log."""

from pathlib import Path

from sensors.errors import EgolocError
from sensors.geodesy import MapFrame


def chosen_frame(text: str | None) -> MapFrame | None:
    """The frame of a text (``sensors.maps.frame_text``), or of the map or log that it names; None: none was asked for.

    Raises EgolocError where it is neither, and where the file has no frame.
    """
    from sensors.maps.frame_text import frame_of
    from sensors.maps.map_file import open_map

    if text is None or not Path(text).exists():
        return None if text is None else frame_of(text)
    path = Path(text)
    if path.suffix.lower() != ".mcap":
        with open_map(path) as opened:
            return opened.frame
    from sensors.mcap.io import read_pieces

    frame = next((piece.map_frame for piece in read_pieces(path)), None)
    if frame is None:
        raise EgolocError(f"{path}: expected a log with a map frame, got one without")
    return frame
