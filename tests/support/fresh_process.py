"""Python in a process of its own, as on a machine without a display."""

import os
import subprocess
import sys

DRAW = """
import mujoco
with mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 16, 16) as renderer:
    renderer.render()
"""


def run(code, **variables):
    """Run ``code`` in another process, without a display and with nothing said about OpenGL but ``variables``."""
    inherited = {key: value for key, value in os.environ.items() if key not in ("DISPLAY", "MUJOCO_GL")}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env=inherited | variables, capture_output=True, text=True, timeout=200)
