"""Colours and names of what is drawn of a run, and how two runs are told apart."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from replay.canvas import Colour

PLACED = {"gnss_position": "GNSS", "pose_fix": "EgoVM"}
"""Sensors that give a place of their own, and so have a track and errors."""
STATUS = ("no fix", "single", "DGNSS", "RTK float", "RTK fixed")
STATUS_COLOURS = dict(zip(STATUS, (0x7A2E2EFF, 0xC0453CFF, 0xC77F2CFF, 0xBFAE35FF, 0x3F8A48FF), strict=True))
GATE_COLOURS = {
    "accepted": 0x3F8A48FF,
    "partly_accepted": 0x8DA83AFF,
    "modes_agree": 0x5FA88AFF,
    "used_for_alignment": 0x3B6FB5FF,
    "chi_square": 0xC0453CFF,
    "covariance": 0xC77F2CFF,
    "multi_modal": 0xB5622FFF,
    "status": 0xA06A2AFF,
    "receiver": 0x9A4F6EFF,
}
HEALTH = ("initializing", "healthy", "degraded", "dead reckoning", "diverged", "recovered")
"""The words of fusion.health.Health, by its codes."""
HEALTH_COLOURS = dict(
    zip(HEALTH, (0x5B5F66FF, 0x3F8A48FF, 0xBFAE35FF, 0xC77F2CFF, 0xC0453CFF, 0x3B6FB5FF), strict=True)
)
WIDTHS = (4.0, 2.8, 1.8, 1.2, 0.8)
"""Of the tracks, in the palettes' order, screen points."""
HIDDEN_COLOURS = {"hidden on purpose": 0x5A4E8CFF}
REJECTED: Colour = (240, 70, 60)
LIMIT: Colour = (200, 60, 60)
PALETTES: Sequence[Mapping[str, Colour]] = (
    {
        "reference": (170, 170, 170),
        "GNSS": (240, 145, 40),
        "EgoVM": (80, 180, 95),
        "smoothed": (90, 215, 225),
        "fused": (85, 145, 255),
    },
    {
        "reference": (120, 120, 120),
        "GNSS": (165, 95, 25),
        "EgoVM": (40, 120, 65),
        "smoothed": (40, 140, 150),
        "fused": (235, 85, 195),
    },
)
XYZ: Sequence[Sequence[Colour]] = (
    ((230, 95, 85), (95, 190, 100), (85, 145, 255)),
    ((150, 60, 55), (55, 120, 60), (55, 90, 165)),
)
SENSOR_COLOURS: Mapping[str, Colour] = {
    "gnss_velocity": (240, 200, 90),
    "gnss_yaw": (190, 130, 220),
    "wheel": (90, 200, 200),
    "zero_velocity": (150, 150, 150),
    "non_holonomic": (120, 120, 160),
}


@dataclass(frozen=True)
class Style:
    """How a run is told from another: palette and axes' colours, the end of its legend entries and lane paths.

    alone: there is no second run to be compared with; sensors: draw the sensors' own tracks and errors (of two runs of
    one log, once is enough); dimming: of colours that are not in the palette.
    """

    palette: Mapping[str, Colour]
    xyz: Sequence[Colour]
    label: str = ""
    suffix: str = ""
    alone: bool = True
    sensors: bool = True
    dimming: float = 1.0

    def of_sensor(self, sensor: str) -> Colour:
        """The colour of a sensor's innovations."""
        if sensor in PLACED:
            return self.palette[PLACED[sensor]]
        red, green, blue = (round(self.dimming * part) for part in SENSOR_COLOURS.get(sensor, LIMIT))
        return red, green, blue


def styles(names: Sequence[str], *, same_log: bool) -> list[Style]:
    """One run's style, or two runs', named as in `names`."""
    if len(names) == 1:
        return [Style(PALETTES[0], XYZ[0])]
    first, second = ((f" {name}", f"/{name}") for name in names)
    return [
        Style(PALETTES[0], XYZ[0], *first, alone=False),
        Style(PALETTES[1], XYZ[1], *second, alone=False, sensors=not same_log, dimming=0.6),
    ]


def sensor_words(sensor: str) -> str:
    """A sensor's name as a person reads it."""
    return sensor.replace("_", " ").replace("gnss", "GNSS").replace("pose fix", "EgoVM pose fix")
