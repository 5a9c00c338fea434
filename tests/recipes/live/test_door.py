"""One port for viewer and pads: what is led where, who is refused, who is heard."""

import contextlib
import http.server
import json
import socket
import threading
import time
import urllib.request

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from nht.recipes.live.door import Door


class Viewer(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        body = f"the viewer's {self.path}".encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_):
        pass


@pytest.fixture
def viewer():
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Viewer) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server.server_port
        server.shutdown()


@pytest.fixture
def heard():
    return []


@pytest.fixture
def door(viewer, heard):
    with Door(port=0) as door:
        door.open(viewer, lambda pad, said: heard.append((pad, said)))
        yield door


def pad(door, **options):
    return connect(f"ws://localhost:{door.port}/pad", **options)


def until(condition, seconds=10.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.01)


def test_pages_come_from_the_viewer(door):
    with urllib.request.urlopen(f"{door.address}/a?b=1") as answer:
        assert answer.read() == b"the viewer's /a?b=1"


def test_what_a_pad_says_is_heard_and_that_it_leaves(door, heard):
    with pad(door) as mine:
        mine.send(json.dumps({"action": [0.5, 0.0]}))
        until(lambda: heard)
    until(lambda: len(heard) == 2)
    (name, said), (left, nothing) = heard
    assert said == {"action": [0.5, 0.0]}
    assert (left, nothing) == (name, {})


def test_all_pads_are_told_the_same_and_those_that_come_later_too(door):
    with pad(door) as first:
        first.recv()
        door.tell({"axes": 2})
        assert json.loads(first.recv(timeout=10)) == {"axes": 2}
        with pad(door) as second:
            assert json.loads(second.recv(timeout=10)) == {"axes": 2}
            door.tell({"action": [1.0, 0.0]})
            assert (
                json.loads(first.recv(timeout=10))
                == json.loads(second.recv(timeout=10))
                == {"action": [1.0, 0.0]}
            )


def test_one_pad_alone_can_be_told_something(door, heard):
    with pad(door) as first, pad(door) as second:
        first.send('{"hello": 1}')
        until(lambda: heard)
        door.tell({"reached": 5}, heard[0][0])
        door.tell({"axes": 2})
        told = [
            [json.loads(each.recv(timeout=10)) for _ in range(count)]
            for each, count in ((first, 3), (second, 2))
        ]
    assert told == [[{}, {"reached": 5}, {"axes": 2}], [{}, {"axes": 2}]]


@pytest.mark.parametrize("said", ["no JSON", "[1, 2]", '"text"', "{"])
def test_nonsense_is_passed_over(door, heard, said):
    with pad(door) as mine:
        mine.send(said)
        mine.send('{"action": [1.0]}')
        until(lambda: heard)
    assert heard[0][1] == {"action": [1.0]}


def test_pages_of_other_sites_are_refused(door):
    with pytest.raises(InvalidStatus, match="403"):
        pad(door, origin="http://elsewhere.example")
    with pad(door, origin=f"http://localhost:{door.port}"):
        pass


@pytest.mark.parametrize("sent", [b"\r\n\r\n", b"GET\r\n\r\n", b"\xff\xfe\r\n\r\n", b"x" * 100_000])
def test_what_is_no_request_is_hung_up_on_and_the_door_stays_open(door, sent):
    with socket.create_connection(("127.0.0.1", door.port), timeout=10) as guest:
        guest.sendall(sent)
        guest.shutdown(socket.SHUT_WR)
        with contextlib.suppress(ConnectionResetError):
            assert guest.recv(100) == b""
    with urllib.request.urlopen(door.address) as answer:
        assert answer.status == 200


def test_it_listens_on_this_machine_alone_unless_told(door):
    assert door.host == "127.0.0.1"
    assert door.address == f"http://localhost:{door.port}"


def test_a_port_in_use_is_told_with_what_to_do():
    with (
        Door(port=0) as first,
        pytest.raises(OSError, match=f"port {first.port} of 127.0.0.1 is in use: .* port=") as told,
    ):
        Door(port=first.port)
    assert str(told.value.strerror).endswith("for any that is free.")


def test_ports_and_addresses_that_do_not_exist_are_told():
    with pytest.raises(ValueError, match=r"port must be in 0 \.\.\. 65535, got 70000"):
        Door(port=70_000)
    with pytest.raises(OSError, match=r"cannot listen on 192\.0\.2\.1, port 0: .* host=127"):
        Door("192.0.2.1", 0)


def test_a_closed_door_lets_nobody_in_and_its_port_is_free(viewer):
    door = Door(port=0)
    door.open(viewer, lambda *_: None)
    with pad(door):
        door.close()
    door.close()
    Door(port=door.port).close()
