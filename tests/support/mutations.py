"""Changes to files as damage, mistakes and malice make them, drawn from a seeded generator."""

import csv
import io
import json
import random
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

VALUES: list[Any] = [
    None,
    True,
    False,
    -1,
    0,
    1,
    7,
    0.5,
    1e308,
    float("nan"),
    float("inf"),
    2**31,
    2**63,
    2**80,
    -(2**63),
    "",
    "x",
    "1",
    "é\n\t",
    "../../outside/file",
    "/etc/passwd",
    "float64",
    "torch.int8",
    "os:system",
    "x" * 5000,
    [],
    {},
    [1, 2, 3],
    [10**12],
    [[1, 2], [3]],
    {"a": 1},
]


def flip_bits(content: bytes, rng: random.Random) -> bytes:
    changed = bytearray(content)
    for _ in range(rng.choice([1, 1, 1, 8])):
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def cut(content: bytes, rng: random.Random) -> bytes:
    return content[: rng.randrange(len(content))]


def insert(content: bytes, rng: random.Random) -> bytes:
    place = rng.randrange(len(content) + 1)
    return content[:place] + rng.randbytes(rng.randint(1, 64)) + content[place:]


def delete(content: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(len(content))
    return content[:start] + content[start + rng.randint(1, 64) :]


def repeat(content: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(len(content))
    end = start + rng.randint(1, 64)
    return content[:end] + content[start:]


def swap_spans(content: bytes, rng: random.Random) -> bytes:
    first, second = sorted(rng.randrange(len(content)) for _ in range(2))
    width = rng.randint(1, 16)
    changed = bytearray(content)
    changed[first : first + width], changed[second : second + width] = (
        content[second : second + width],
        content[first : first + width],
    )
    return bytes(changed)


BYTES: list[Callable[[bytes, random.Random], bytes]] = [flip_bits, cut, insert, delete, repeat, swap_spans]


def change_value(value: Any, rng: random.Random) -> Any:
    """Another value, type, name or order somewhere within a nested one; text that is JSON is opened."""
    if isinstance(value, str) and value[:1] == "{" and rng.random() < 0.8:
        return json.dumps(change_value(json.loads(value), rng))
    if isinstance(value, dict) and value and rng.random() < 0.9:
        name, kind = rng.choice(list(value)), rng.random()
        if kind < 0.1:
            return {key: one for key, one in value.items() if key != name}
        if kind < 0.2:
            return {(f"{key}x" if key == name else key): one for key, one in value.items()}
        if kind < 0.3:
            return value | {name: value[rng.choice(list(value))]}
        return value | {name: change_value(value[name], rng)}
    if isinstance(value, list) and value and rng.random() < 0.8:
        place, kind = rng.randrange(len(value)), rng.random()
        if kind < 0.2:
            return value[:place] + value[place + 1 :]
        if kind < 0.4:
            return value[:place] + value[place:][:1] + value[place:]
        return [change_value(one, rng) if number == place else one for number, one in enumerate(value)]
    return rng.choice(VALUES)


def change_json(content: bytes, rng: random.Random) -> bytes:
    return json.dumps(change_value(json.loads(content), rng)).encode()


def change_yaml(content: bytes, rng: random.Random) -> bytes:
    return yaml.safe_dump(change_value(yaml.safe_load(content), rng), sort_keys=False).encode()


def change_csv(content: bytes, rng: random.Random) -> bytes:
    rows = list(csv.reader(io.StringIO(content.decode(), newline="")))
    row = rng.choice(rows)
    place, kind = rng.randrange(len(row)), rng.random()
    if kind < 0.7:
        row[place] = str(rng.choice(VALUES))
    elif kind < 0.8:
        rows.append(list(row))
    elif kind < 0.9:
        del row[place]
    else:
        other = rng.choice(rows)
        row[place] = other[min(place, len(other) - 1)]
    output = io.StringIO(newline="")
    csv.writer(output).writerows(rows)
    return output.getvalue().encode()


def change_header(content: bytes, rng: random.Random) -> bytes:
    """Of a safetensors file."""
    (length,) = struct.unpack("<Q", content[:8])
    header = change_json(content[8 : 8 + length], rng)
    return struct.pack("<Q", len(header)) + header + content[8 + length :]


def change_member(content: bytes, rng: random.Random) -> bytes:
    """Of a ZIP archive, with right checksums of ZIP; mostly of its manifest."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = "manifest.json" if rng.random() < 0.5 else rng.choice(list(members))
    change = change_json if name.endswith(".json") and rng.random() < 0.8 else rng.choice(BYTES)
    members[name] = change(members[name], rng)
    output = io.BytesIO()
    with zipfile.ZipFile(output, "w") as archive:
        for member, data in members.items():
            archive.writestr(member, data)
    return output.getvalue()


STRUCTURED = {
    ".json": change_json,
    ".yaml": change_yaml,
    ".csv": change_csv,
    ".safetensors": change_header,
    ".torchrl": change_member,
}


def mutated(file: Path, rng: random.Random) -> bytes:
    """The contents of a file, changed."""
    before = file.read_bytes()
    structured = STRUCTURED.get(file.suffix)
    while True:
        change = structured if structured is not None and rng.random() < 0.6 else rng.choice(BYTES)
        if (after := change(before, rng)) != before:
            return after
