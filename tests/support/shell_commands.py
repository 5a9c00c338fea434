"""The commands of the pages: what bash makes of a block, with programs replaced by notes of their arguments."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
PROGRAMS = ("python", "nht", "torchrun", "make", "pip", "wandb", "ray", "pytest", "git")
NOTES = '{ printf "%s\\0" "${0##*/}" "$@"; printf "\\036\\0"; } >> "$COMMANDS"\n'
# What stands for a program that a page only starts others with, or asks a batch system.
OTHERS = {"srun": '"$@"\n', "scontrol": "echo node-1\n", "cd": ""}
BATCH = {
    "SLURM_JOB_ID": "7",
    "SLURM_JOB_NUM_NODES": "2",
    "SLURM_ARRAY_TASK_ID": "1",
    "SLURM_CPUS_PER_TASK": "2",
    "SLURM_JOB_NODELIST": "node-[1-2]",
}


def name_of(page: Path) -> str:
    """A page's path, from the root."""
    return str(page.relative_to(ROOT))


def blocks(page: Path, language: str) -> list[str]:
    """The blocks of code of a language on a page."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)


@cache
def commands(page: Path) -> tuple[tuple[str, ...], ...]:
    """Every command of a page's shell blocks, as its program would get it: variables, loops and quotes are bash's."""
    return tuple(command for block in blocks(page, "sh") for command in commands_of(block))


def commands_of(block: str) -> list[tuple[str, ...]]:
    """The commands that a block of shell starts.

    Raises:
        ValueError: if bash refuses the block, or it starts a program that is not in ``PROGRAMS``.
    """
    scratch = Path(_scratch())
    noted = scratch / "commands"
    noted.write_bytes(b"")
    place = {"PATH": str(scratch / "bin"), "COMMANDS": str(noted), "HOME": str(scratch)} | BATCH
    script = "set -eu\n" + re.sub(r"<this repository>", "here", block)
    bash = shutil.which("bash") or "/bin/bash"
    done = subprocess.run([bash, "-c", script], cwd=scratch, env=place, capture_output=True, text=True)
    if done.returncode:
        raise ValueError(f"{done.stderr.strip()} in:\n{block}")
    found = noted.read_bytes().decode().split("\036\0")
    return [tuple(words.split("\0")[:-1]) for words in found if words]


@cache
def _scratch() -> str:
    import tempfile

    scratch = Path(tempfile.mkdtemp(prefix="commands-"))
    (scratch / "bin").mkdir()
    (scratch / "nht").mkdir()  # where a page's `cd nht` leads
    for name, body in {**dict.fromkeys(PROGRAMS, NOTES), **OTHERS}.items():
        file = scratch / "bin" / name
        file.write_text(f"#!{shutil.which('bash')}\n{body}")
        file.chmod(0o755)
    head = shutil.which("head")
    assert head is not None
    os.symlink(head, scratch / "bin" / "head")
    return str(scratch)
