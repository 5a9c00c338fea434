"""Steer a robot through a learned action map, in the browser; record what is done as demonstrations.

python -m nht.recipes.steer map.file=runs/nht.safetensors env=wam_wipe
python -m nht.recipes.steer run=runs/ddpg-wam_wipe-nht-seed0
python -m nht.recipes.steer env=gymnasium env.name=Pusher-v5
"""

from __future__ import annotations

from nht.recipes.config import Steer
from nht.recipes.launch import launch
from nht.recipes.live.opening import open_page
from nht.recipes.live.pace import keep_pace, until_told_to_end


def main(config: Steer) -> None:
    """Open the page, and keep the task running until Ctrl-C or SIGTERM."""
    with until_told_to_end(), open_page(config) as (session, page):
        print(f"steer at {page.address}, as many as want to; Ctrl-C ends.", flush=True)
        keep_pace(session, page.show)


if __name__ == "__main__":
    launch(main, Steer, "steer")
