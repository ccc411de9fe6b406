"""XLA's optimised programs, read back as data: kernels, launches, loops, traffic."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

_HEAD = re.compile(r"^(ENTRY )?%?([\w.\-]+) \(.*\) -> .* \{$")
_LINE = re.compile(r"^\s+(ROOT )?%?([\w.\-]+) = (.*)$")
_ARRAY = re.compile(r"\b([a-z]+\d*)\w*\[([\d,]*)\]")
_TRIPS = re.compile(r'"known_trip_count":\{"n":"(\d+)"\}')
_BITS = re.compile(r"\d+")


@dataclass(frozen=True)
class Instruction:
    """One line of a computation, with XLA's text of its shape and its attributes."""

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
    """A compiled module, and the name of the computation that is the program."""

    computations: dict[str, Computation]
    entry: str


def parse(text: str) -> Program:
    """Read a module in XLA's own notation."""
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


FREE = frozenset(
    (
        "parameter",
        "constant",
        "tuple",
        "get-tuple-element",
        "bitcast",
        "after-all",
        "opt-barrier",
        "copy-done",
        "async-done",
        "partition-id",
    )
)
"""Operations that launch nothing."""


@dataclass(frozen=True)
class Kernel:
    """A kernel of the program, with the bytes that a launch reads and writes, each once."""

    name: str
    launches: int  # of a call of the program; loops of an unknown number of turns count once
    read: int
    written: int


def kernels(program: Program) -> list[Kernel]:
    """Return the kernels of a program, those of branches too."""
    return list(_kernels(program, program.entry, 1))


def loops(program: Program) -> list[int | None]:
    """Turns of the loops of a program; None where only the data tell when one ends."""
    return [
        line.trips
        for computation in program.computations.values()
        for line in computation.values()
        if line.op == "while"
    ]


def longest_chain(program: Program) -> int:
    """Return how many launches wait for one another, however many run side by side.

    Loops of an unknown number of turns count once, and of branches the longest.
    """
    return _chain(program, program.entry)


def _kernels(program: Program, name: str, times: int) -> Iterator[Kernel]:
    computation = program.computations[name]
    for line in computation.values():
        if line.op in FREE:
            continue
        inner = _inner(line)
        if not inner:
            read, written = _traffic(program, computation, line)
            yield Kernel(line.name, times, read, written)
        for part in inner:
            yield from _kernels(program, part, times * _turns(line))


def _inner(line: Instruction) -> list[str]:
    """Names of the computations whose kernels an instruction launches."""
    if line.op == "while":
        # The condition of a counted loop is not evaluated.
        return line.called("body") if line.trips is not None else line.called("body", "condition")
    if line.op == "conditional":
        return line.branches()
    if line.op == "call":
        return line.called("to_apply")
    if line.op.endswith("-start"):
        return line.called("calls")
    return []


def _turns(line: Instruction) -> int:
    return line.trips if line.op == "while" and line.trips is not None else 1


def _chain(program: Program, name: str) -> int:
    depth: dict[str, int] = {}
    for line in program.computations[name].values():
        before = max((depth.get(operand, 0) for operand in line.operands), default=0)
        parts = [_chain(program, part) for part in _inner(line)]
        if not parts:
            own = 0 if line.op in FREE else 1
        elif line.op == "conditional":
            own = max(parts)
        else:
            own = _turns(line) * sum(parts)
        depth[line.name] = before + own
    return max(depth.values(), default=0)


def _traffic(program: Program, computation: Computation, line: Instruction) -> tuple[int, int]:
    """Bytes that a kernel reads and writes; slices of an array count as what they take."""
    if line.op != "fusion":
        operands = (computation[name] for name in line.operands if name in computation)
        return sum(operand.num_bytes for operand in operands), line.num_bytes
    body = program.computations[line.called("calls")[0]]
    users: dict[str, list[tuple[Instruction, int]]] = defaultdict(list)
    for part in body.values():
        for position, name in enumerate(part.operands):
            users[name].append((part, position))

    def read(part: Instruction, whole: int) -> int:
        total = 0
        for user, position in users[part.name]:
            if user.op in ("slice", "dynamic-slice", "gather") and position == 0:
                total += user.num_bytes
            elif user.op == "bitcast":
                total += read(user, whole)
            elif user.op != "dynamic-update-slice" or position > 0:
                return whole
        return min(total, whole)

    def written(part: Instruction) -> int:
        if part.op == "bitcast":
            return written(body[part.operands[0]])
        if part.op == "dynamic-update-slice":
            return body[part.operands[1]].num_bytes
        if part.op == "tuple":
            return sum(written(body[name]) for name in part.operands)
        return part.num_bytes

    inputs = (part for part in body.values() if part.op == "parameter")
    root = next(part for part in body.values() if part.is_root)
    return sum(read(part, part.num_bytes) for part in inputs), written(root)
