"""Reads the file that W&B keeps of an offline run: a LevelDB log of protocol buffers."""

import json
import struct
import time

BLOCK, HEADER, ENDS = 32_768, 7, (1, 4)
"""Blocks of records, each with check sum, length and whether it is whole or the last of several."""


def records(file):
    """The records of a ``.wandb`` file."""
    from wandb.proto.wandb_internal_pb2 import Record

    data, at, parts = file.read_bytes(), HEADER, b""
    while at + HEADER <= len(data):
        if (left := BLOCK - at % BLOCK) < HEADER:
            at += left
            continue
        _, length, kind = struct.unpack_from("<IHB", data, at)
        parts += data[at + HEADER : at + HEADER + length]
        at += HEADER + length
        if kind in ENDS:
            yield Record.FromString(parts)
            parts = b""


def files(folder):
    """The files of the offline runs in a folder, in the order that they were begun in."""
    return sorted(folder.glob("wandb/offline-run-*/*.wandb"), key=lambda file: file.stat().st_ctime)


def written(file):
    """The records of an offline run, once W&B's own process has written the last one."""
    until = time.monotonic() + 60
    while not any(record.HasField("exit") for record in records(file)):
        assert time.monotonic() < until
        time.sleep(0.1)
    return list(records(file))


class OfflineRun:
    """What stands in the file of an offline run.

    ``run``: its record, with id, names, group, job type, notes, tags. ``config`` and ``summary``: nested, by name.
    ``rows``: of its history. ``artifacts``: by name without a version, handed on or taken. ``metrics``: how they are
    defined, by name. ``exit_code``: of the end.
    """

    def __init__(self, file):
        self.run, self.config, self.summary = None, {}, {}
        self.rows, self.artifacts, self.metrics, self.exit_code = [], {}, {}, None
        for record in written(file):
            self._read(record)

    def _read(self, record):
        if record.HasField("run"):
            self.run = record.run
            _fill(self.config, record.run.config.update)
        if record.HasField("config"):
            _fill(self.config, record.config.update)
        if record.HasField("summary"):
            _fill(self.summary, record.summary.update)
        if record.HasField("metric"):
            self.metrics[record.metric.name or record.metric.glob_name] = record.metric
        if record.HasField("artifact"):
            self.artifacts[record.artifact.name] = record.artifact
        if record.HasField("exit"):
            self.exit_code = record.exit.exit_code
        if record.history.item:
            row = {}
            _fill(row, record.history.item)
            self.rows.append(row)

    def column(self, name):
        """The values of a metric, by environment steps."""
        return {row["env_steps"]: row[name] for row in self.rows if name in row}


def _fill(place, items):
    for item in items:
        inner = place
        *outer, last = list(item.nested_key) or [item.key]
        for name in outer:
            inner = inner.setdefault(name, {})
        inner[last] = json.loads(item.value_json)


def read_run(folder):
    """The only offline run in a folder."""
    (file,) = files(folder)
    return OfflineRun(file)
