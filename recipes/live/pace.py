"""Real time: when the next step is due, when the next picture is, and when all ends."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from nht.recipes.live.session import Session

PICTURES = 50.0
"""Pictures per second, at most."""
SLOW = 1 / 30
"""Steps that are farther apart [s] are shown on their way."""
SOONER = 0.8
"""A picture may follow a step so much sooner, as a share of the time between pictures: then each step has its own."""
PAUSE = 1.5
"""Seconds for which an end, or the goal, stays to be seen before the next episode begins by itself."""
BEHIND = 0.25
"""Seconds by which steps may be late before the clock gives up on catching up."""


def keep_pace(
    session: Session, show: Callable[[float], object], going: Callable[[], bool] = lambda: True
) -> None:
    """Step a session in real time, times its speed, and show it, until ``going`` says no.

    Steps are made when they are due, one for each picture or several; a picture follows the step. Where steps are far
    apart, in slow motion or by the task's own clock, pictures show the way from one to the next. While nothing moves,
    pictures go on, so that what people press shows at once.

    Args:
        session: what is stepped.
        show: draws it; told which part of the last step's way is to be seen.
        going: asked before every turn.
    """
    clock = time.monotonic
    due = shown = stepped_at = clock()
    ended_at: float | None = None
    while going():
        session.settle()
        now = clock()
        period = float(session.task.time_per_step) / max(session.speed, 1e-3)
        if session.at_rest and session.goes_on and not session.paused:
            ended_at = now if ended_at is None else ended_at
            if now - ended_at > PAUSE:
                session.next_goal()
                ended_at = None
        else:
            ended_at = None
        stepped = now >= due
        if stepped:
            session.step()
            stepped_at = clock()
            due = due + period if now - due < BEHIND else now + period
        now = clock()
        if now - shown >= (SOONER if stepped else 1.0) / PICTURES:
            shown = now
            show(min(1.0, (now - stepped_at) / period) if period > SLOW else 1.0)
        wait = min(due, shown + 1.0 / PICTURES) - clock()
        if wait > 0:
            time.sleep(min(wait, 1.0 / PICTURES))


@contextmanager
def until_told_to_end() -> Iterator[None]:
    """Within, Ctrl-C and SIGTERM end what goes on, without a traceback; all that is open is closed in order."""
    known = threading.current_thread() is threading.main_thread()  # elsewhere Python knows no signals
    before = signal.signal(signal.SIGTERM, signal.default_int_handler) if known else None
    try:
        yield
    except KeyboardInterrupt:
        pass
    finally:
        if known:
            signal.signal(signal.SIGTERM, before)
