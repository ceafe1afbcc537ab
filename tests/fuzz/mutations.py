"""Seeded mutations of bytes: the same seed gives the same inputs on every machine."""

from __future__ import annotations

import random
import re

TOKENS = (
    *(b"0", b"-1", b"1e999", b"-1e999", b"nan", b"NaN", b"Infinity", b".inf", b"9" * 400, b"1e308", b"4294967296"),
    *(b"null", b"true", b"~", b"[]", b"{}", b'""', b"[[[[[[[[", b"{{{{{{{{", b"&a [*a]", b"!!map x", b"<<: *a"),
    *(b"2001-99-99", b"../", b"%s%n", b" ", b"\n", b"\r\n", b":", b",", b"-", b"\0", b"\xff", b"\x80"),
    *(b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\xed\xa0\x80", b"\xe2\x80\xa8"),
)
"""What parsers stumble over."""

MAX_BYTES = 1 << 20
"""A mutated input is not longer."""

_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def mutated(seeds: list[bytes], chance: random.Random) -> bytes:
    """Returns one of the seeds after one to eight mutations."""
    data = bytearray(chance.choice(seeds))
    for _ in range(chance.choice((1, 1, 1, 2, 2, 4, 8))):
        data = _mutate(data, seeds, chance)
    return bytes(data[:MAX_BYTES])


def _mutate(data: bytearray, seeds: list[bytes], chance: random.Random) -> bytearray:
    at = chance.randrange(len(data) + 1)
    end = min(len(data), at + chance.choice((1, 2, 4, 8, 64, 1000)))
    match chance.randrange(11):
        case 0 if data:  # flips a bit
            data[at % len(data)] ^= 1 << chance.randrange(8)
        case 1:  # sets bytes
            data[at:end] = chance.randbytes(end - at)
        case 2:  # removes
            del data[at:end]
        case 3:  # repeats
            data[at:at] = data[at:end] * chance.choice((1, 2, 50))
        case 4:  # cuts off
            del data[at:]
        case 5:  # joins with another one
            other = chance.choice(seeds)
            data[at:] = other[chance.randrange(len(other) + 1) :]
        case 6:
            data[at:at] = chance.choice(TOKENS)
        case 7:
            data[at : at + chance.choice((0, 1, 4, 8))] = chance.choice(TOKENS)
        case _:  # another number, most often
            numbers = list(_NUMBER.finditer(data))
            if numbers:
                number = chance.choice(numbers)
                data[number.start() : number.end()] = chance.choice(TOKENS)
    return data
