"""Texts that are tags: what a scene or a drive mode may say."""

import numpy as np

from sensors.mcap.columns import Topic
from sensors.mcap.decoded import NO_LOG_TIME, Decoded
from sensors.records import Tags

MAX_TEXT = 200
"""The longest text that is taken for tags, characters."""
TOO_LONG = f"text is longer than {MAX_TEXT} characters"
NOT_TEXT = "text is not printable UTF-8"
_REPLACED = "\ufffd"
"""What stands for bytes that are not UTF-8."""


def problem(text: str) -> str | None:
    """Why a text cannot be tags, or None."""
    if len(text) > MAX_TEXT:
        return TOO_LONG
    return None if text.isprintable() and _REPLACED not in text else NOT_TEXT


def decode_tags(topic: Topic) -> Decoded:
    """std_msgs/String; it has no header, so the log time is its stamp."""
    texts = [text for (text,) in topic.row_texts()]
    problems = {text: problem(text) for text in set(texts)}
    why = [problems[text] for text in texts]
    valid = {reason: np.array([w != reason for w in why], bool) for reason in (TOO_LONG, NOT_TEXT)}
    text = np.array(["" if w else text for text, w in zip(texts, why, strict=True)], np.str_)
    log_time = topic.log_time()
    valid[NO_LOG_TIME] = log_time >= 0
    return Decoded(Tags, {"t_ns": log_time, "arrival_ns": log_time, "text": text}, valid, late=True)
