"""XLA's optimised programs, as it writes them, read back as data."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

_HEAD = re.compile(r"^(ENTRY )?%?([\w.\-]+) \(.*\) -> .* \{$")
_LINE = re.compile(r"^\s+(ROOT )?%?([\w.\-]+) = (.*)$")
_ARRAY = re.compile(r"\b([a-z]+\d*)\w*\[([\d,]*)\]")
_TRIPS = re.compile(r'"known_trip_count":\{"n":"(\d+)"\}')
_BITS = re.compile(r"\d+")


@dataclass(frozen=True)
class Instruction:
    """One line of a computation.

    Attributes:
        name: unique in the computation.
        shape: what it returns, as XLA writes it.
        op: the operation, such as ``fusion``.
        operands: names of what it reads.
        attributes: the rest of the line.
        is_root: whether the computation returns it.
    """

    name: str
    shape: str
    op: str
    operands: tuple[str, ...]
    attributes: str
    is_root: bool

    @property
    def num_bytes(self) -> int:
        """Bytes of what it returns."""
        return sum(_num_bytes(*array) for array in _ARRAY.findall(self.shape))

    @property
    def trips(self) -> int | None:
        """Turns of a loop; None where XLA does not know them."""
        known = _TRIPS.search(self.attributes)
        return int(known[1]) if known else None

    def called(self, *roles: str) -> list[str]:
        """Names of the computations that it calls in these roles, such as ``body``."""
        found = (re.search(rf"\b{role}=%?([\w.\-]+)", self.attributes) for role in roles)
        return [match[1] for match in found if match]

    def branches(self) -> list[str]:
        """Names of the computations among which a conditional chooses."""
        listed = re.search(r"branch_computations=\{(.*?)\}", self.attributes)
        if listed:
            return re.findall(r"%([\w.\-]+)", listed[1])
        return self.called("true_computation", "false_computation")


Computation = dict[str, Instruction]


@dataclass(frozen=True)
class Program:
    """A compiled module.

    Attributes:
        computations: instructions by name, for each computation.
        entry: name of the computation that is the program.
    """

    computations: dict[str, Computation]
    entry: str


def parse(text: str) -> Program:
    """Read a module in XLA's own notation.

    Raises:
        ValueError: it has no entry.
    """
    computations: dict[str, Computation] = {}
    entry, current = "", None
    for line in text.splitlines():
        head = _HEAD.match(line)
        if head:
            current = computations.setdefault(head[2], {})
            entry = head[2] if head[1] else entry
        elif line.startswith("}"):
            current = None
        elif current is not None and (found := _LINE.match(line)):
            instruction = _instruction(found[2], found[3], is_root=bool(found[1]))
            current[instruction.name] = instruction
    if not entry:
        raise ValueError("this is no program of XLA: it has no ENTRY.")
    return Program(computations, entry)


def _instruction(name: str, text: str, is_root: bool) -> Instruction:
    text = re.sub(r"/\*.*?\*/", "", text)
    end = _closing(text) if text.startswith("(") else text.index(" ") - 1
    shape, text = text[: end + 1], text[end + 2 :]
    op, _, _ = text.partition("(")
    end = _closing(text)
    inside = "" if op == "constant" else text[len(op) : end]
    operands = tuple(re.findall(r"%([\w.\-]+)", inside))
    return Instruction(name, shape, op, operands, text[end + 1 :], is_root)


def _closing(text: str) -> int:
    """Return where the first parenthesis is closed."""
    depth = 0
    for match in re.finditer(r"[()]", text):
        depth += 1 if match[0] == "(" else -1
        if depth == 0:
            return match.start()
    return len(text) - 1


def _num_bytes(kind: str, dimensions: str) -> int:
    count = math.prod(int(size) for size in dimensions.split(",") if size)
    if kind == "pred":
        return count
    bits = _BITS.search(kind)
    return count * max(1, int(bits[0]) // 8) if bits else 0
