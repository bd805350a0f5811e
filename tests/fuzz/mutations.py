"""Ways to break the bytes of a file or a message. Every choice comes from the given random generator."""

import random
import re
from collections.abc import Sequence

NUMBERS = (
    b"0", b"-1", b"1e308", b"1e999", b"-1e-320", b"nan", b"inf", b"-inf", b"2147483648", b"9223372036854775808",
    b"1" + b"0" * 50, b"9" * 5000, b"0x7f", b"1_0", b"1:30", b"",
)  # fmt: skip
"""Replacements of a number in a text."""
TOKENS = (
    b"\x00", b"\xff\xfe", b"\n", b"\r", b"\t", b":", b"[" * 2000, b"{a: " * 500, b"- " * 2000, b"&a [*a]", b"*a",
    b"!!python/object:os.system", b"2020-13-45", b"? [1, 2]", b"<<: ", b"../../outside", b"/etc/passwd", b"null",
    b"!!float ''", b"!!int ''", b"!!timestamp x", b"!!binary x", b"true", b"'", b'"', b"%", b"{", b"a" * 100_000,
)  # fmt: skip
"""Insertions into a text."""
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")


def mutate(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """``data``, broken one to four times; ``others`` are there to be spliced in."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        data = rng.choice((_flip, _edit, _number, _token, _lines, _integer, _cut))(rng, data)
    if rng.random() < 0.05:
        other = rng.choice(others)
        data = data[: rng.randrange(len(data) + 1)] + other[rng.randrange(len(other) + 1) :]
    return data


def _flip(rng: random.Random, data: bytes) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.choice((1, 2, 8)) if data else 0):
        bit = rng.randrange(8 * len(data))
        changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


def _edit(rng: random.Random, data: bytes) -> bytes:
    at, removed = rng.randrange(len(data) + 1), rng.choice((0, 0, 1, 4, 100))
    return data[:at] + rng.randbytes(rng.choice((0, 1, 4, 16))) + data[at + removed :]


def _integer(rng: random.Random, data: bytes) -> bytes:
    """A binary number, as of a length or a count, becomes another one."""
    size, at = rng.choice((1, 2, 4, 8)), rng.randrange(len(data) + 1)
    value = rng.choice((0, 1, 2 ** (8 * size) - 1, 2 ** (8 * size - 1), 2 ** (8 * size - 1) - 1, 2 ** (4 * size)))
    return data[:at] + value.to_bytes(size, rng.choice(("little", "big"))) + data[at + size :]


def _number(rng: random.Random, data: bytes) -> bytes:
    found = list(_NUMBER.finditer(data, *_window(rng, data)))
    if not found:
        return data
    chosen = rng.choice(found)
    return data[: chosen.start()] + rng.choice(NUMBERS) + data[chosen.end() :]


def _token(rng: random.Random, data: bytes) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.choice(TOKENS) + data[at:]


def _lines(rng: random.Random, data: bytes) -> bytes:
    """A line is left out, doubled or moved."""
    lines = data.split(b"\n")
    line = lines.pop(rng.randrange(len(lines)))
    for _ in range(rng.choice((0, 1, 2, 20))):
        lines.insert(rng.randrange(len(lines) + 1), line)
    return b"\n".join(lines)


def _cut(rng: random.Random, data: bytes) -> bytes:
    return data[: rng.randrange(len(data) + 1)] if rng.random() < 0.3 else data


def _window(rng: random.Random, data: bytes) -> tuple[int, int]:
    """A part of the data, so that a large file takes no longer than a small one."""
    at = max(0, rng.randrange(len(data) + 1) - 500)
    return at, at + 1000
