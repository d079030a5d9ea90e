"""How far the reading of a log has come, and when to look for windows that are complete."""

from collections.abc import Sequence

from sensors.mcap.columns import Topic
from sensors.screening import APART_NS, JUMP_NS

HOLD_NS = JUMP_NS
"""A row may come so much later than the IMU's of its time and still be put into its window."""


class Pace:
    """How far reading has come: up_to a log time, after the log has been running for active_ns.

    An hour or more without any message is not running: the clock was set. due_ns: when to look for windows next.
    """

    def __init__(self, due_ns: int, max_rows: int) -> None:
        self.up_to = 0
        self.active_ns = 0
        self._due_ns = due_ns
        self._fresh_ns = 0
        self._max_rows = self._most_rows = max_rows
        self._started = False

    def read(self, up_to: int) -> None:
        """Everything up to a log time was read."""
        step = up_to - self.up_to if self._started else APART_NS
        self._started = True
        if 0 < step < APART_NS:
            self.active_ns += step
        if step > 0 or step <= -APART_NS:
            self.up_to = up_to

    def is_due(self, topics: Sequence[Topic]) -> bool:
        """Whether it is time to look for complete windows."""
        return self.active_ns >= self._due_ns or any(topic.rows >= self._most_rows for topic in topics)

    def is_stale(self, topics: Sequence[Topic]) -> bool:
        """Whether rows have waited long enough to be discarded if they are still bad the next time."""
        if self.active_ns < self._fresh_ns and not any(topic.rows >= self._max_rows for topic in topics):
            return False
        self._fresh_ns = self.active_ns + 2 * HOLD_NS
        return True

    def wait(self, length_ns: int, topics: Sequence[Topic]) -> None:
        """Look again after so much more of the log."""
        self._due_ns = self.active_ns + length_ns
        self._most_rows = self._max_rows + max((topic.rows for topic in topics), default=0)
