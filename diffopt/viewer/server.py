"""The page: viser serves it, a session draws for each browser that opens it."""

import contextlib
import io
import ipaddress
import socket
import threading
from typing import Any

import numpy as np

from diffopt.errors import InputError, missing
from diffopt.viewer import gltf, panels
from diffopt.viewer.building import Builder
from diffopt.viewer.controls import Control, Menu, Slider, Steps, Toggle
from diffopt.viewer.screen import GoneError, Times, valid_camera
from diffopt.viewer.session import Session
from diffopt.viewer.subject import Coloured, Row, Subject

# A browser that takes longer than this for a frame is taken to be gone, seconds.
_PATIENCE = 20.0
# Rows of pixels at most: a large window is shown a smaller picture.
_MOST_ROWS = 1080
_JPEG = 90
_MESH = "/subject"


class Server:
    """Serves a subject to browsers until it is closed.

    Parameters
    ----------
    subject
        What is looked at.
    host
        Address to listen on: this machine alone unless another one is given.
    port
        0 for any that is free.

    Attributes
    ----------
    url
        To open.
    sessions
        Of browsers that are there, by their numbers.

    Raises
    ------
    InputError
        If viser is not installed, or the port is taken.
    """

    def __init__(self, subject: Subject, host: str = "127.0.0.1", port: int = 8080) -> None:
        viser = require()
        _free(host, port)
        self.subject, self.builder = subject, Builder(subject.build)
        self.sessions: dict[int, Session] = {}
        self._gone: dict[int, threading.Event] = {}
        self._lock = threading.Lock()
        # It prints a banner of its own.
        with contextlib.redirect_stdout(io.StringIO()):
            self._server = viser.ViserServer(host=host, port=port, label="diffopt", verbose=False)
        # A button of the page would open a tunnel to another host.
        self._server.request_share_url = lambda *_, **__: None
        place = subject.place
        first = self._server.initial_camera
        first.position, first.look_at, first.up = place.eye, place.target, place.up
        first.fov = float(np.radians(place.field_of_view))
        self._server.gui.configure_theme(
            control_width="large",
            dark_mode=True,
            show_logo=False,
            show_share_button=False,
        )
        self._server.gui.main_panel.dock_right()
        self._server.scene.set_up_direction(place.up)
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._left)
        self.port = self._server.get_port()
        shown = f"[{host}]" if ":" in host else host
        self.url = f"http://{'127.0.0.1' if shown in ('0.0.0.0', '[::]') else shown}:{self.port}"

    def close(self, timeout: float = 0.0) -> bool:
        """Stop serving; sessions end. Whether what was in work has ended within a time, seconds."""
        sessions = list(self.sessions.values())
        for session in sessions:
            session.close()
        self.builder.close()
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()
        return all([session.join(timeout) for session in sessions] + [self.builder.join(timeout)])

    def wait(self) -> None:
        """Serve until interrupted."""
        threading.Event().wait()

    def _connected(self, client: Any) -> None:
        gone = threading.Event()
        screen = _Page(client, self.subject.title, gone)
        session = Session(self.subject, self.builder, screen, _camera(client))
        screen.fill(session)

        @client.camera.on_update
        def _(_: Any) -> None:
            with contextlib.suppress(InputError):
                session.look(_camera(client))

        with self._lock:
            self.sessions[client.client_id] = session
            self._gone[client.client_id] = gone
        session.start()

    def _left(self, client: Any) -> None:
        with self._lock:
            session = self.sessions.pop(client.client_id, None)
            gone = self._gone.pop(client.client_id, None)
        if session is not None and gone is not None:
            gone.set()
            session.close()


class _Page:
    """The screen of one browser."""

    def __init__(self, client: Any, title: str, gone: threading.Event) -> None:
        self._client, self._gone = client, gone
        self._mesh: Any = None
        with client.atomic():
            client.gui.set_panel_label("diffopt")
            client.gui.add_markdown(f"**{title}**")
            self._status = client.gui.add_markdown("…")
            client.scene.set_background_image(panels.backdrop())

    def fill(self, session: Session) -> None:
        """Put the controls into the page."""
        gui = self._client.gui
        for control in session.controls:
            handle = _widget(gui, control)
            handle.on_update(_listener(self, session, control, handle))
        self._table = gui.add_html("")

    def refuse(self, text: str) -> None:
        """Say why a value was not taken."""
        with contextlib.suppress(Exception):
            self._client.add_notification("Not taken", text, auto_close_seconds=8.0, color="red")

    def show(self, pixels: np.ndarray) -> None:
        """See `diffopt.viewer.screen.Screen`."""
        with self._alive(), self._client.atomic():
            if self._mesh is not None:
                self._mesh.visible = False
            self._client.scene.set_background_image(pixels, format="jpeg", jpeg_quality=_JPEG)
        self._arrived()

    def colour(self, found: Coloured | None) -> None:
        """See `diffopt.viewer.screen.Screen`."""
        with self._alive(), self._client.atomic():
            if found is not None:
                self._send(gltf.encode(found))
            self._mesh.visible = True
            self._client.scene.set_background_image(panels.backdrop())
        self._arrived()

    def _send(self, data: bytes) -> None:
        if self._mesh is None:
            self._mesh = self._client.scene.add_glb(
                _MESH, data, cast_shadow=False, receive_shadow=False
            )
        else:
            self._mesh.glb_data = data

    def tell(self, rows: list[Row], times: Times | None, status: str) -> None:
        """See `diffopt.viewer.screen.Screen`."""
        with self._alive():
            self._status.content = panels.status(times, status)
            self._table.content = panels.table(rows)

    def _arrived(self) -> None:
        """Wait until the browser has worked off what was sent: it answers in order."""
        with self._alive():
            self._client.flush()
            self._client.local_storage.get_item("frame", timeout=_PATIENCE)

    @contextlib.contextmanager
    def _alive(self) -> Any:
        if self._gone.is_set():
            raise GoneError("the page was closed")
        try:
            yield
        except (RuntimeError, TimeoutError, OSError, Warning) as error:
            # Between the check and here it may have been closed; viser warns of that.
            raise GoneError(str(error)) from None


def _listener(page: _Page, session: Session, control: Control, handle: Any) -> Any:
    """What happens when a control is moved."""

    def moved(_: Any) -> None:
        value = handle.value
        if isinstance(control, Steps):
            place = value if isinstance(value, int) else -1
            value = control.options[place] if 0 <= place < len(control.options) else value
        try:
            session.set(control.name, value)
        except InputError as error:
            page.refuse(str(error))
            handle.value = _shown(control, session.values[control.name])
        if isinstance(control, Steps):
            handle.label = _label(control, session.values[control.name])

    return moved


def _shown(control: Control, value: Any) -> Any:
    return control.options.index(value) if isinstance(control, Steps) else value


def _label(control: Steps, value: float) -> str:
    """The box beside the slider shows a place, so the label has the number."""
    return f"{control.label} {value:g}"


def _widget(gui: Any, control: Control) -> Any:
    hint = control.hint or None
    if isinstance(control, Slider):
        return gui.add_slider(
            control.label,
            min=control.least,
            max=control.most,
            step=control.step,
            initial_value=control.value,
            hint=hint,
        )
    if isinstance(control, Steps):
        marks = tuple((k, f"{option:g}") for k, option in enumerate(control.options))
        return gui.add_slider(
            _label(control, control.value),
            min=0,
            max=len(marks) - 1,
            step=1,
            initial_value=control.options.index(control.value),
            marks=marks,
            hint=hint,
        )
    if isinstance(control, Menu):
        return gui.add_dropdown(
            control.label, control.options, initial_value=control.value, hint=hint
        )
    assert isinstance(control, Toggle)
    return gui.add_checkbox(control.label, control.value, hint=hint)


def _camera(client: Any) -> Any:
    camera = client.camera
    w, x, y, z = (float(q) for q in camera.wxyz)
    axes = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    columns, rows = max(int(camera.image_width), 1), max(int(camera.image_height), 1)
    if rows > _MOST_ROWS:
        columns, rows = max(columns * _MOST_ROWS // rows, 1), _MOST_ROWS
    return valid_camera(camera.position, axes, float(camera.fov), (columns, rows))


def require() -> Any:
    """The module viser.

    Raises
    ------
    InputError
        If it is not installed: how to install it.
    """
    try:
        import viser
    except ImportError:
        raise missing("the viewer", "viser", "view") from None
    return viser


def _free(host: str, port: int) -> None:
    """Refuse a port that is taken: viser would silently take the next one."""
    if not 0 <= port <= 65535:
        raise InputError(f"port must lie between 0 and 65535; received {port}")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise InputError(
                f"cannot listen on {host} port {port}: {error.strerror or error}; "
                "choose another --port (0 for any that is free)"
            ) from None


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach an address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
