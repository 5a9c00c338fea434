"""The panel beside the scene: the pad, what can be chosen and pressed, and what is told."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any

from viser import GuiApi

from nht.envs.arrays import Array
from nht.recipes.live.session import FAILED, PERSON, POLICY, RUNNING, SUCCESS, Session

PAD = Path(__file__).parent / "pad.html"
OUTCOMES = {RUNNING: "#777", SUCCESS: "#1e963c", FAILED: "#c82828"}
"""Colour of how an episode stands."""
SPARK = 200
"""Values of the critic that are drawn."""


class Controls:
    """Everything that people press or read, the same for all who look.

    Args:
        gui: of the viewer.
        session: what is steered.
        goes_about: whether the robot can leave its place.

    Attributes:
        arrows, trail: whether these are to be drawn.
        follow: whether a robot that goes about is to stay in sight.
    """

    def __init__(self, gui: GuiApi, session: Session, *, goes_about: bool = False) -> None:
        self._gui, self._session = gui, session
        self._shown: dict[int, str] = {}
        self._values: list[float] = []
        self._status = gui.add_html("")
        height = 210 if max(each.action_dim for each in session.interfaces.values()) <= 9 else 360
        gui.add_html(
            f'<iframe id="pad" title="pad" allow="gamepad" style="width:100%;height:{height}px;border:0" '
            f'srcdoc="{escape(PAD.read_text())}"></iframe>'
        )
        self._choose: Any = gui.add_dropdown(
            "Interface", list(session.interfaces), initial_value=session.interface.name
        )
        self._on(self._choose, lambda now, value: now.choose(value))
        drivers = (PERSON,) if session.pilot is None else (PERSON, POLICY)
        self._drive: Any = gui.add_dropdown(
            "Driver", drivers, initial_value=session.driver, hint="A hand on the pad takes over at any time."
        )
        self._on(self._drive, lambda now, value: now.drive(value))
        self._buttons("Episode", {"Next goal": lambda now: now.next_goal(), "Reset": lambda now: now.reset()})
        speed = gui.add_slider(
            "Speed", min=0.1, max=max(2.0, session.speed), step=0.1, initial_value=session.speed
        )
        self._on(speed, lambda now, value: setattr(now, "speed", float(value)))
        self._checkbox("Pause", False, lambda now, value: setattr(now, "paused", value))
        self._checkbox("Go on by itself", session.goes_on, lambda now, value: setattr(now, "goes_on", value))
        self.follow = gui.add_checkbox("Follow the robot", True, visible=goes_about)
        with gui.add_folder("Record"):
            self._recording = gui.add_html("")
            self._record = gui.add_button("Record")
            self._record.on_click(lambda _: session.post(lambda now: now.record(not now.recorder.on)))
            self._buttons(
                "Episodes",
                {"Save": lambda now: now.save(), "Discard last": lambda now: now.recorder.discard()},
            )
        self._message = gui.add_html("")
        with gui.add_folder("Basis"):
            self.arrows = gui.add_checkbox("Arrows", True)
            self.trail = gui.add_checkbox("Trail", True)
            self._bars = gui.add_html("")

    def _on(self, control: Any, change: Callable[[Session, Any], object]) -> None:
        @control.on_update
        def _(event: Any) -> None:
            value = event.target.value
            if event.client is not None:  # not what we set ourselves
                self._session.post(lambda now: change(now, value))

    def _buttons(self, label: str, changes: dict[str, Callable[[Session], object]]) -> None:
        group = self._gui.add_button_group(label, list(changes))
        group.on_click(lambda event: self._session.post(changes[event.target.value]))

    def _checkbox(self, label: str, value: bool, change: Callable[[Session, bool], object]) -> None:
        self._on(self._gui.add_checkbox(label, value), change)

    def tell(self, bars: str, tool: Array) -> None:
        """Bring what is written up to date.

        Args:
            bars: of the basis, as HTML.
            tool: where it is [m], ``(3,)``.
        """
        now = self._session
        if now.pilot is not None and (value := now.value()) is not None and not now.ended:
            self._values = [*self._values[-SPARK + 1 :], value]
        self._write(self._status, _status(now, self._values, tool))
        self._write(self._bars, bars)
        self._write(self._recording, _recording(now))
        self._write(self._message, _line(escape(now.message)) if now.message else "")
        label = "Stop" if now.recorder.on else "Record"
        if self._record.label != label:
            self._record.label = label
        if self._choose.value != now.interface.name:
            self._choose.value = now.interface.name
        if self._drive.value != now.driver:
            self._drive.value = now.driver

    def _write(self, place: Any, text: str) -> None:
        """HTML is sent only when it has changed."""
        if self._shown.get(id(place)) != text:
            self._shown[id(place)] = text
            place.content = text


def _line(text: str) -> str:
    return f'<div style="padding:0.2em 0.9em;font-size:0.82em;overflow-wrap:anywhere">{text}</div>'


def _status(now: Session, values: list[float], tool: Array) -> str:
    colour = OUTCOMES.get(now.outcome, "#b7791f")
    through = (
        now.pilot.interface.name if now.pilot is not None and now.driving == POLICY else now.interface.name
    )
    told = (
        f'<span data-clock>{now.seconds:.1f} s</span> &nbsp; <b data-outcome style="color:{colour}">{now.outcome}</b>'
        f" &nbsp; {now.driving} through {escape(through)}"
    )
    if now.paused:
        told += " &nbsp; paused"
    place = " ".join(f"{part:.3f}" for part in tool)
    lines = [_line(told), _line(f"tool at <span data-tool>{place}</span> m")]
    if now.pilot is not None and now.pilot.critic is None:
        lines.append(_line(escape(now.pilot.no_critic)))
    elif values:
        of = (
            "this action"
            if now.pilot and now.pilot.critic and now.pilot.critic.judges_actions
            else "the state"
        )
        lines.append(
            _line(f"<span data-value>the critic expects {values[-1]:.2f}</span> of {of}{_spark(values)}")
        )
    return "".join(lines)


def _spark(values: list[float]) -> str:
    low, high = min(values), max(values)
    points = [
        f"{100 * place / max(len(values) - 1, 1):.1f},{22 - 20 * (value - low) / max(high - low, 1e-6):.1f}"
        for place, value in enumerate(values)
    ]
    return (
        '<svg viewBox="0 0 100 24" preserveAspectRatio="none" style="width:100%;height:24px"><polyline fill="none" '
        f'stroke="#2b6cb0" vector-effect="non-scaling-stroke" points="{" ".join(points)}"/></svg>'
    )


def _recording(now: Session) -> str:
    kept = now.recorder
    dot = '<span style="color:#c82828">●</span> recording' if kept.on else "not recording"
    return _line(
        f"{dot}: <span data-recorded>{kept.transitions}</span> steps, {len(kept.episodes)} whole episodes"
    )
