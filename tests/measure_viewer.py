"""Frames per second and latency of the viewer at 1280x720, in a headless browser, by hand:

    python tests/measure_viewer.py [disc] [teapot STORE.zarr] [creature]

Latency is from the key that moves a slider until the browser has worked off the frame with the
new value; frames per second are those of the camera being turned all the time.
"""

import statistics
import sys
import time

import browsing
import jax

from diffopt import samples
from diffopt.viewer.screen import PIXELS, VERTICES
from diffopt.viewer.server import Server

# The panel covers 388 pixels: the picture beside it has 1280 x 720.
WINDOW = (1668, 720)
MOVES = 15


def subjects(words):
    from diffopt.cli import view

    while words:
        word = words.pop(0)
        if word == "disc":
            from diffopt.viewer.diffracting import Diffracting

            scan = samples.compact_disc(jax.random.key(0))
            yield word, Diffracting(scan, coherence=3.2, name="disc"), "light azimuth"
        elif word == "creature":
            yield word, view._shadow(word, "animation", None), "light azimuth"
        else:
            yield word, view._scene(word, words.pop(0)), "environment turned"


def measured(name, subject, slider):
    server = Server(subject, port=0)
    with browsing.browser() as found:
        page, _ = browsing.opened(found, server.url + "/?fixedDpr=1", WINDOW)
        begun = time.perf_counter()
        browsing.wait_for(page, lambda: server.sessions, what="a session")
        session = next(iter(server.sessions.values()))
        browsing.wait_for(page, lambda: session.log, 200.0, "a frame")
        first = time.perf_counter() - begun
        if "play" in session.values:
            playing = rate(page, session, 4.0)
            session.set("play", False)
        browsing.wait_for(page, lambda: session._faster, 60.0, "the faster way")
        handle = page.locator("label", has_text=slider).first.locator("xpath=../../..")
        print(f"{name}: first frame after {first:.1f} s; the faster way is {session._faster}")
        if "play" in subject.controls[0].name:
            print(f"  playing: {playing:.1f} frames/s")
        for way in (VERTICES, PIXELS):
            session.set("drawn", way)
            page.wait_for_timeout(2500)
            handle.get_by_role("slider").focus()
            taken = [moved(page, session) for _ in range(MOVES)]
            one = session.log[-1]
            taken.sort()
            half = statistics.median(taken)
            page.mouse.move(400, 500)
            page.mouse.down()
            frames, rate_ = turning(page, session)
            page.mouse.up()
            drawn, shown = (
                1e3 * statistics.median(getattr(frame, name) for frame in frames)
                for name in ("drawn", "shown")
            )
            print(
                f"  {way:8}: slider to picture {1e3 * half:.0f} ms ({1e3 * taken[0]:.0f} .. "
                f"{1e3 * taken[-1]:.0f}); turning {rate_:.1f} frames/s, at the end of "
                f"{frames[-1].size}, medians {drawn:.0f} ms to compute, {shown:.0f} ms to show"
            )
            page.wait_for_timeout(3000)
            if way == PIXELS:
                one = session.log[-1]
                print(f"  at rest: {one.size} in {1e3 * one.drawn:.0f} ms a take")
    server.close(20.0)


def moved(page, session):
    page.wait_for_timeout(600)
    version, begun = len(session.log), time.perf_counter()
    before = session.log[-1]
    page.keyboard.press("ArrowRight")
    while session.log[-1] is before and len(session.log) == version:
        page.wait_for_timeout(1)
    return time.perf_counter() - begun


def turning(page, session, seconds=4.0):
    """Frames while the camera is turned, and how many a second."""
    return followed(page, session, seconds, 4, turn=True)


def rate(page, session, seconds):
    page.wait_for_timeout(2000)
    return followed(page, session, seconds, 20)[1]


def followed(page, session, seconds, wait, turn=False):
    # Frames are compared by identity, and kept so that none gets the identity of another.
    last, begun, k, frames = session.log[-1], time.perf_counter(), 0, []
    while time.perf_counter() - begun < seconds:
        k += 1
        if turn:
            page.mouse.move(400 + (7 * k) % 500, 500 - (3 * k) % 200)
        page.wait_for_timeout(wait)
        log = session.log
        place = next((n for n, t in enumerate(log) if t is last), -1)
        frames += log[place + 1 :]
        last = log[-1]
    return frames, len(frames) / (time.perf_counter() - begun)


if __name__ == "__main__":
    for each in subjects(sys.argv[1:] or ["disc", "creature"]):
        measured(*each)
