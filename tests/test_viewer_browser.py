"""The viewer as a browser shows it, headless; skipped where there is none."""

import contextlib
import socket
import subprocess
import sys

import browsing
import jax
import numpy as np
import pytest

from diffopt import samples
from diffopt.cli import main
from diffopt.errors import InputError
from diffopt.viewer import server
from diffopt.viewer.diffracting import Diffracting
from diffopt.viewer.server import Server

pytestmark = pytest.mark.slow
SIZE = (900, 500)
# Where there is no panel and no message.
CANVAS = (0, 180, 480, 320)


@pytest.fixture(scope="module")
def running():
    scan = samples.compact_disc(jax.random.key(0), shape=(128, 128), pixel=0.1)
    found = Server(Diffracting(scan, coherence=0.8, name="disc"), port=0)
    yield found
    assert found.close(60.0)


@pytest.fixture(scope="module")
def chromium():
    with browsing.browser() as found:
        yield found


@contextlib.contextmanager
def viewing(chromium, running):
    """A page that shows a frame, and its session."""
    known = set(running.sessions)
    page, outside = browsing.opened(chromium, running.url, SIZE)
    try:
        fresh = browsing.wait_for(page, lambda: set(running.sessions) - known, what="a session")
        session = running.sessions[fresh.pop()]
        browsing.wait_for(page, lambda: session.log, 120.0, "a frame")
        yield page, session
        assert outside == []  # nothing is asked of another machine
    finally:
        page.close()


def settled(page, session):
    """The picture when nothing changes any longer, on the page either.

    A busy machine shows a frame some time after it was sent.
    """
    browsing.wait_for(page, lambda: session._faster is not None, what="the faster way")
    count, before = -1, None
    for _ in range(60):
        picture = browsing.pixels(page, CANVAS)
        if count == len(session.log) and before is not None and (picture == before).all():
            return picture
        count, before = len(session.log), picture
        page.wait_for_timeout(700)
    pytest.fail("the picture did not come to rest")


def control(page, name):
    """The row of the panel with a label."""
    return page.locator("label", has_text=name).first.locator("xpath=../../..")


def test_the_page_shows_the_object_and_what_is_in_it(running, chromium):
    with viewing(chromium, running) as (page, session):
        settled(page, session)

        def shown():
            """Whether there is an object, and background around it."""
            rows = browsing.pixels(page, CANVAS)
            behind = rows[:, :4].mean((1, 2))
            different = np.abs(rows - behind[:, None, None]).max(-1) > 25
            return 0.05 < different.mean() < 0.95

        browsing.wait_for(page, shown, what="the object before the background")
        rows = browsing.pixels(page, CANVAS)
        assert np.ptp(rows, axis=-1).max() > 60  # and the object is coloured
        assert page.get_by_text("disc: diffraction").count()
        assert page.get_by_text("of a mirror's peak").count()
        text = page.inner_text("body")
        assert "ms to compute" in text
        assert "frames/s" in text


def test_a_slider_changes_the_picture(running, chromium):
    with viewing(chromium, running) as (page, session):
        before, was = settled(page, session), session.values["azimuth"]
        handle = control(page, "light azimuth").get_by_role("slider")
        handle.focus()
        for _ in range(15):
            page.keyboard.press("ArrowRight")
        browsing.wait_for(page, lambda: session.values["azimuth"] == was + 15.0, what="the value")
        after = settled(page, session)
        assert np.abs(after - before).mean() > 1.0


@pytest.mark.long
def test_a_new_table_is_built_while_frames_go_on(running, chromium):
    with viewing(chromium, running) as (page, session):
        before = settled(page, session)
        session.set("depth", 2.0)
        count = len(session.log)
        session.set("exposure", 1.0)
        browsing.wait_for(page, lambda: len(session.log) > count, 5.0, "a frame")
        browsing.wait_for(
            page, lambda: "heights ×2" in page.inner_text("body"), 120.0, "the new table"
        )
        assert np.abs(settled(page, session) - before).mean() > 1.0


@pytest.mark.long
def test_two_look_at_once_each_at_their_own(running, chromium):
    with (
        viewing(chromium, running) as (one, first),
        viewing(chromium, running) as (two, second),
    ):
        a, b = settled(one, first), settled(two, second)
        assert np.abs(a - b).mean() < 2.0
        first.set("azimuth", 90.0)
        two.mouse.move(200, 350)
        two.mouse.down()
        two.mouse.move(330, 330, steps=8)
        two.mouse.up()
        assert np.abs(settled(one, first) - a).mean() > 1.0
        turned = settled(two, second)
        assert np.abs(turned - b).mean() > 1.0
        assert second.values["azimuth"] != 90.0
        # The camera is the browser's: both have orbited to where it says.
        assert first._camera.eye != second._camera.eye


@pytest.mark.long
def test_one_that_vanishes_in_the_middle_of_a_frame_leaves_the_others(running, chromium):
    with viewing(chromium, running) as (stays, second):
        settled(stays, second)
        with viewing(chromium, running) as (page, first):
            first.set("drawn", "pixels")
            first.set("azimuth", 10.0)
            page.close()
            assert first.join(30.0)
        count = len(second.log)
        second.set("azimuth", -10.0)
        browsing.wait_for(stays, lambda: len(second.log) > count, 10.0, "a frame of the other")


@pytest.mark.long
def test_a_value_that_is_typed_wrongly_is_not_taken(running, chromium):
    with viewing(chromium, running) as (page, session):
        settled(page, session)
        box = control(page, "heights ×").get_by_role("textbox")
        for words in ("-4", "900", "1e999", "much"):
            box.fill(words)
            page.keyboard.press("Enter")
            page.wait_for_timeout(300)
            assert 0.1 <= session.values["depth"] <= 3.0
        with pytest.raises(InputError, match=r"depth must be a number from 0\.1 to 3"):
            session.set("depth", 900.0)


def test_a_port_that_is_taken_is_said(running):
    with pytest.raises(InputError, match=f"port {running.port}"):
        Server(running.subject, port=running.port)
    with pytest.raises(InputError, match="port must lie between"):
        Server(running.subject, port=70000)


def test_it_listens_to_this_machine_alone(running):
    assert server.is_loopback("127.0.0.1")
    assert server.is_loopback("::1")
    assert server.is_loopback("localhost")
    assert not server.is_loopback("0.0.0.0")
    assert not server.is_loopback("example.org")
    with socket.socket() as probe:
        probe.settimeout(5.0)
        probe.connect(("127.0.0.1", running.port))
    # 127.0.0.2 is this machine as well, but not where it listens.
    with socket.socket() as probe:
        probe.settimeout(5.0)
        assert probe.connect_ex(("127.0.0.2", running.port)) != 0
    # The page's button for a tunnel to another host does nothing.
    assert running._server.request_share_url() is None


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["nothing"], "no such file, and not the name of a scene"),
        (["a.zarr"], "diffopt view SCENE --transfer a.zarr"),
        (["balls", "--coherence", "2"], "--coherence are for heights"),
        (["creature", "--transfer", "a.zarr"], "--transfer is for a scene"),
        (["missing.sur"], "no such file"),
        (["sample:compact_disc", "--port", "-1"], "port must lie between"),
    ],
)
def test_the_command_says_what_is_wrong(words, said, capsys):
    assert main(["view", *words, "--no-open"]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


def test_without_viser_the_command_says_how_to_get_it():
    code = (
        "import sys; sys.modules['viser'] = None\n"
        "from diffopt.cli import main\n"
        "sys.exit(main(['view', 'balls']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 2
    assert "the viewer needs viser: pip install viser" in done.stderr
    assert done.stderr.count("\n") == 1
