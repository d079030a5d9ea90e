"""Loops over the bytes of MCAP records (numba). Arrays in and out; every length is bounded by what remains."""

from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from sensors.kernel import kernel

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]

RECORD_HEADER = 9
"""Opcode (1) and length (8)."""
MESSAGE_HEADER = 22
"""Channel id (2), sequence (4), log time (8), publish time (8)."""
_MESSAGE = 5


@kernel(allocates=True, nogil=True, inline="always")
def _int64(buffer: Bytes, at: int) -> Any:
    value = np.int64(0)
    for k in range(8):
        value |= np.int64(buffer[at + k]) << np.int64(8 * k)
    return value


@intrinsic
def _move8(_context: Any, target: Any, target_at: Any, source: Any, source_at: Any) -> Any:
    """Copy 8 bytes between byte arrays with one unaligned load and store (a loop over bytes is three times slower)."""
    signature = types.void(target, types.int64, source, types.int64)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        word = ir.IntType(64).as_pointer()
        pointers = []
        for kind, array, at in zip(signature.args[::2], args[::2], args[1::2], strict=True):
            data = context.make_array(kind)(context, builder, array).data
            pointers.append(builder.bitcast(builder.gep(data, [at]), word))
        value = builder.load(pointers[1])
        value.align = 1
        builder.store(value, pointers[0]).align = 1
        return context.get_dummy_value()

    return signature, generate


@kernel(allocates=True, nogil=True, inline="always")
def _copy(target: Bytes, target_at: int, source: Bytes, source_at: int, size: int) -> None:
    words = size >> 3
    for k in range(words):
        _move8(target, target_at + 8 * k, source, source_at + 8 * k)
    for k in range(8 * words, size):
        target[target_at + k] = source[source_at + k]


@kernel(allocates=True, nogil=True)
def scan(
    buffer: Bytes,
    cursor: int,
    stop: int,
    slot_of: NDArray[np.int32],
    at: Ints,
    size: Ints,
    slot: NDArray[np.int32],
    log_time: Ints,
) -> tuple[int, int, int]:
    """Index the run of whole message records that starts at cursor.

    slot_of: (65536,) channel id -> slot, -1 unknown channel, -2 not wanted. Fills at (payload offset), size (of the
    payload), slot and log_time up to their capacity. Returns (indexed, next cursor, messages of unknown channels).
    """
    count = 0
    unknown = 0
    while count < len(at) and stop - cursor >= RECORD_HEADER and buffer[cursor] == _MESSAGE:
        length = _int64(buffer, cursor + 1)
        if length < MESSAGE_HEADER or length > stop - cursor - RECORD_HEADER:
            break
        mine = slot_of[np.int64(buffer[cursor + 9]) | (np.int64(buffer[cursor + 10]) << 8)]
        if mine >= 0:
            at[count] = cursor + RECORD_HEADER + MESSAGE_HEADER
            size[count] = length - MESSAGE_HEADER
            slot[count] = mine
            log_time[count] = _int64(buffer, cursor + 15)
            count += 1
        elif mine == -1:
            unknown += 1
        cursor += RECORD_HEADER + length
    return count, cursor, unknown


@kernel(allocates=True, nogil=True)
def run_of_messages(buffer: Bytes, cursor: int, stop: int) -> int:
    """Where the run of whole message records that starts at cursor ends (at most a record beyond stop)."""
    total = len(buffer)
    while cursor < stop and total - cursor >= RECORD_HEADER and buffer[cursor] == _MESSAGE:
        length = _int64(buffer, cursor + 1)
        if length < MESSAGE_HEADER or length > total - cursor - RECORD_HEADER:
            break
        cursor += RECORD_HEADER + length
    return cursor


@kernel(allocates=True, nogil=True)
def gather(
    buffer: Bytes,
    at: Ints,
    size: Ints,
    slot: NDArray[np.int32],
    log_time: Ints,
    first: int,
    count: int,
    mine: int,
    expected: int,
    checks: Ints,
    sample: Bytes,
    copies: Ints,
    rows: Bytes,
    times: Ints,
    filled: int,
) -> tuple[int, int]:
    """Copy the wanted bytes of messages first..count of one slot into rows, while they are laid out alike.

    expected: payload size (-1: any, -2: none). checks: (K, 2) offset, length that must equal the sample's bytes.
    copies: (K, 3) payload offset, row offset, length. rows: (capacity, row size). Returns (message at which it stopped,
    rows filled): it stops at the end, when rows are full, or at a message that is laid out differently.
    """
    flat = rows.reshape(-1)
    for i in range(first, count):
        if slot[i] != mine:
            continue
        if filled == len(rows) or (expected != -1 and size[i] != expected):
            return i, filled
        start = at[i]
        for c in range(len(checks)):
            for b in range(checks[c, 0], checks[c, 0] + checks[c, 1]):
                if buffer[start + b] != sample[b]:
                    return i, filled
        for c in range(len(copies)):
            _copy(flat, filled * rows.shape[1] + copies[c, 1], buffer, start + copies[c, 0], copies[c, 2])
        times[filled] = log_time[i]
        filled += 1
    return count, filled


@kernel(allocates=True, nogil=True)
def scatter(rows: Bytes, starts: Ints, out: Bytes) -> None:
    """Copy each of rows (N, size) to its place in out: (N,) starts."""
    flat = rows.reshape(-1)
    for i in range(len(rows)):
        _copy(out, starts[i], flat, i * rows.shape[1], rows.shape[1])
