"""``NAME[:SEVERITY][@BEGIN[+LENGTH]]``: a fault that is asked for, in words."""

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass

from sensors.errors import EgolocError
from sensors.simulate.faults import FAULTS, SEVERITIES, Fault

BEGIN_S = 60.0
"""Where none is said, s."""
LONGEST_S = 7 * 86_400.0
_FORM = re.compile(r"(?P<name>[^:@+]+)(:(?P<severity>[^:@+]*))?(@(?P<begin>[^:@+]*)(\+(?P<length>[^:@+]*))?)?")


@dataclass(frozen=True)
class Injection:
    """A fault from begin_s (s since the first IMU sample) on, for length_s."""

    fault: Fault
    severity: str
    begin_s: float
    length_s: float

    @property
    def spec(self) -> str:
        """With everything said."""
        return f"{self.fault.name}:{self.severity}@{self.begin_s:.15g}+{self.length_s:.15g}"

    @property
    def told(self) -> str:
        """What happens, in words."""
        return self.fault.told(self.severity, self.length_s)


def parse(specs: Iterable[str], where: str = "--inject") -> tuple[Injection, ...]:
    """Every fault of specs, each one or several with commas between them. Raises EgolocError for one that is none."""
    return tuple(_parse(text.strip(), where) for spec in specs for text in spec.split(","))


def _parse(text: str, where: str) -> Injection:
    found = _FORM.fullmatch(text)
    if found is None:
        raise EgolocError(
            f"{where}: expected NAME[:SEVERITY][@BEGIN[+LENGTH]], as in gnss-jump:severe@60+20, got {text!r}"
        )
    name, severity = found["name"], found["severity"] if found["severity"] is not None else "medium"
    if name not in FAULTS:
        raise EgolocError(f"{where}: expected one of the faults {', '.join(FAULTS)}, got {name!r}")
    if severity not in SEVERITIES:
        raise EgolocError(f"{where}: {name}: expected one of the severities {', '.join(SEVERITIES)}, got {severity!r}")
    fault = FAULTS[name]
    begin = _seconds(found["begin"], f"{where}: {name}: BEGIN", BEGIN_S)
    length = _seconds(found["length"], f"{where}: {name}: LENGTH", fault.length_s(severity))
    if length == 0.0:
        raise EgolocError(f"{where}: {name}: LENGTH: expected more than 0 s")
    return Injection(fault, severity, begin, length)


def _seconds(text: str | None, where: str, usual: float) -> float:
    """Seconds in whole nanoseconds."""
    if text is None:
        return usual
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 <= value <= LONGEST_S:
        raise EgolocError(f"{where}: expected seconds, 0 or more and at most a week, got {text!r}")
    return round(value * 1e9) / 1e9
