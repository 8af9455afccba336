"""A viewer's session: what is drawn when, what is built where, and what is refused."""

import threading
import time

import numpy as np
import pytest

from diffopt.errors import InputError
from diffopt.scenes.camera import Camera
from diffopt.viewer import controls, session
from diffopt.viewer.building import Builder, Failure
from diffopt.viewer.controls import Menu, Slider, Steps, Toggle
from diffopt.viewer.screen import PIXELS, VERTICES, GoneError, valid_camera
from diffopt.viewer.session import Session
from diffopt.viewer.subject import Coloured, Meshed, Place, Row, StaleError, Subject

CAMERA = Camera((0.0, -4.0, 0.0), resolution=(120, 80))


class Grey:
    """A picture of one grey, which takes as long as it is told to."""

    title, place = "grey", Place((0.0, -4.0, 0.0), (0.0, 0.0, 0.0))
    takes, averages = 3, False

    def __init__(self, pixel_s=0.0, build_s=0.0):
        self.pixel_s, self.build_s = pixel_s, build_s
        self.controls = (
            Slider("level", "level", 0.0, 255.0, 1.0, 10.0),
            Slider("table", "table", 0.0, 9.0, 1.0, 1.0),
            Toggle("play", "play", False),
        )
        self.built_by = []

    def moves(self, values):
        return values["play"]

    def wanted(self, values, built):
        return {"table": values["table"]}

    def build(self, name, key):
        self.built_by.append(threading.current_thread().name)
        time.sleep(self.build_s)
        if key == 7.0:
            raise InputError("seven cannot be built")
        if key == 8.0:
            raise ZeroDivisionError("eight")
        return key

    def pixels(self, built, look):
        end = time.perf_counter() + self.pixel_s
        while time.perf_counter() < end:
            if look.stale():
                raise StaleError
            time.sleep(0.005)
        rows, columns = look.camera.shape
        value = look.values["level"] + 10 * look.take
        return np.full((rows, columns, 3), [value, 10 * built["table"], 0], np.uint8)

    def rows(self, built, look):
        return [Row("grey", True, f"table {built['table']:g}")]


class GreyMesh(Grey):
    """The same as a mesh as well."""

    turns = True

    def __init__(self, pixel_s=0.0, vertex_s=0.0):
        super().__init__(pixel_s)
        self.vertex_s = vertex_s

    def colours(self, built, look):
        time.sleep(self.vertex_s)
        codes = np.full((3, 3), [look.values["level"], 10 * built["table"], 0], np.uint8)
        return Coloured(np.eye(3), np.array([[0, 1, 2]], np.int32), codes)


class Wall:
    """A screen that remembers; `gone` after so many pictures."""

    def __init__(self, last=None):
        self.shown, self.told, self.last = [], [], last

    def show(self, pixels):
        self.shown.append((time.perf_counter(), PIXELS, pixels))
        if self.last is not None and len(self.shown) > self.last:
            raise GoneError("closed")

    def colour(self, found):
        self.shown.append((time.perf_counter(), VERTICES, found))

    def tell(self, rows, times, status):
        self.told.append((rows, times, status))


def wait(condition, seconds=10.0):
    end = time.perf_counter() + seconds
    while not condition():
        assert time.perf_counter() < end, "it did not come"
        time.sleep(0.005)


@pytest.fixture
def run():
    ends = []

    def start(subject, screen=None, camera=CAMERA):
        screen = screen or Wall()
        builder = Builder(subject.build)
        made = Session(subject, builder, screen, camera)
        made.start()
        ends.append((made, builder))
        return made, screen

    yield start
    for made, builder in ends:
        made.close()
        builder.close()
        assert made.join(10.0)
        assert builder.join(10.0)


def test_the_subject_of_these_tests_is_one():
    assert isinstance(Grey(), Subject)
    assert isinstance(GreyMesh(), Meshed)
    assert not isinstance(Grey(), Meshed)


def test_a_frame_at_rest_is_the_mean_over_takes(run):
    made, wall = run(Grey())
    wait(lambda: wall.shown and wall.shown[-1][2][0, 0, 0] == 20)  # mean of 10, 20, 30
    count = len(wall.shown)
    time.sleep(0.5)
    assert len(wall.shown) == count  # nothing changes: nothing is drawn
    assert wall.shown[-1][2].shape == (80, 120, 3)
    made.set("level", 50.0)
    wait(lambda: wall.shown[-1][2][0, 0, 0] == 60)


def test_frames_in_motion_are_coarse_where_fine_ones_take_long(run):
    made, wall = run(Grey(pixel_s=0.3))
    wait(lambda: len(wall.shown) >= 2)
    made.set("level", 90.0)
    wait(lambda: any(p[0, 0, 0] == 90 for _, _, p in wall.shown))
    first = next(p for _, _, p in wall.shown if p[0, 0, 0] == 90)
    assert first.shape[0] < 80
    wait(lambda: wall.shown[-1][2][0, 0, 0] == 100)
    assert wall.shown[-1][2].shape[0] == 80  # and at rest fine


def test_a_frame_that_is_no_longer_wanted_is_given_up(run):
    made, wall = run(Grey(pixel_s=1.0))
    wait(lambda: len(wall.shown) >= 2)  # the coarse one, and one take
    made.set("level", 100.0)
    begun = time.perf_counter()
    time.sleep(0.2)
    made.set("level", 200.0)
    wait(lambda: any(p[0, 0, 0] == 200 for _, _, p in wall.shown))
    # One coarse frame (1 s) may be in work; the take that was in work is not waited for as well.
    assert time.perf_counter() - begun < 2.9


def test_building_blocks_no_frame(run):
    subject = Grey(build_s=1.0)
    made, wall = run(subject)
    wait(lambda: wall.shown)
    made.set("table", 2.0)
    time.sleep(0.05)
    begun = time.perf_counter()
    made.set("level", 77.0)
    wait(lambda: any(p[0, 0, 0] == 77 for _, _, p in wall.shown))
    assert time.perf_counter() - begun < 0.5
    drawn = next(p for _, _, p in wall.shown if p[0, 0, 0] == 77)
    assert drawn[0, 0, 1] == 10  # by the table before
    wait(lambda: any("building table" in status for *_, status in wall.told))
    wait(lambda: wall.shown[-1][2][0, 0, 1] == 20)
    assert set(subject.built_by) == {"diffopt-builder"}


def test_what_nobody_wants_any_longer_is_not_built(run):
    subject = Grey(build_s=0.3)
    made, wall = run(subject)
    wait(lambda: wall.shown)
    for value in (2.0, 3.0, 4.0, 5.0):
        made.set("table", value)
        time.sleep(0.02)
    wait(lambda: wall.shown[-1][2][0, 0, 1] == 50)
    assert len(subject.built_by) <= 3  # the first, the one in work, the last


@pytest.mark.parametrize(("value", "words"), [(7.0, "seven"), (8.0, "ZeroDivisionError: eight")])
def test_a_failed_build_is_told_and_the_rest_goes_on(run, value, words):
    made, wall = run(Grey())
    wait(lambda: wall.shown)
    made.set("table", value)
    wait(lambda: any(words in status for *_, status in wall.told))
    made.set("level", 66.0)
    wait(lambda: any(p[0, 0, 0] == 66 for _, _, p in wall.shown))
    made.set("table", 3.0)
    wait(lambda: wall.shown[-1][2][0, 0, 1] == 30)


def test_a_viewer_that_is_gone_ends_its_session_alone(run):
    subject = Grey()
    one, _ = run(subject, Wall(last=1))
    two, wall = run(subject)
    assert one.join(10.0)
    wait(lambda: wall.shown)
    two.set("level", 40.0)
    wait(lambda: any(p[0, 0, 0] == 40 for _, _, p in wall.shown))


@pytest.mark.parametrize(
    ("pixel_s", "vertex_s", "wins"), [(0.06, 0.0, VERTICES), (0.0, 0.06, PIXELS)]
)
def test_the_faster_way_is_measured_and_taken(run, pixel_s, vertex_s, wins):
    made, wall = run(GreyMesh(pixel_s, vertex_s))
    wait(lambda: made._faster is not None)
    assert made._faster == wins
    time.sleep(0.4)
    made.set("level", 99.0)
    wait(lambda: wall.shown[-1][1] == PIXELS and wall.shown[-1][2][0, 0, 0] == 109)
    time.sleep(0.05)
    ways = [way for _, way, p in wall.shown if way == VERTICES and p is not None]
    drawn = [p.colours[0, 0] for _, way, p in wall.shown if way == VERTICES]
    assert (99 in drawn) == (wins == VERTICES)
    assert ways  # both were tried


def test_what_moves_is_drawn_again_and_again(run):
    made, wall = run(Grey())
    made.set("play", True)
    wait(lambda: len(wall.shown) > 30)
    made.set("play", False)
    wait(lambda: wall.shown[-1][2][0, 0, 0] == 20)


def test_the_table_beside_tells_times(run):
    _, wall = run(Grey())
    wait(lambda: any(times is not None for _, times, _ in wall.told))
    rows, times, _ = next(each for each in wall.told if each[1] is not None)
    assert rows == [Row("grey", True, "table 1")]
    assert times.way == PIXELS
    assert times.drawn >= 0.0


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("level", 256.0),
        ("level", float("nan")),
        ("level", "loud"),
        ("level", True),
        ("play", 1),
        ("volume", 1.0),
    ],
)
def test_bad_values_are_refused_and_nothing_changes(run, name, value):
    made, _ = run(Grey())
    before = made.values
    with pytest.raises(InputError, match=name):
        made.set(name, value)
    assert made.values == before


def test_controls_take_what_they_show():
    steps = Steps("tolerance", "tolerance", (0.1, 0.01), 0.1)
    assert steps.checked(0.01) == 0.01
    with pytest.raises(InputError, match=r"tolerance must be one of 0\.1, 0\.01; received 0\.05"):
        steps.checked(0.05)
    menu = Menu("drawn", "drawn by", ("a", "b"), "a")
    assert controls.changed([steps, menu], {"drawn": "a"}, "drawn", "b") == {"drawn": "b"}
    x, y, z = controls.light_direction({"azimuth": 90.0, "elevation": 30.0})
    np.testing.assert_allclose([x, y, z], [0.0, np.sqrt(0.75), 0.5], atol=1e-12)
    x, y, z = controls.light_direction({"azimuth": 0.0, "elevation": 90.0}, axis=1)
    np.testing.assert_allclose([x, y, z], [0.0, 1.0, 0.0], atol=1e-12)


def test_a_camera_of_a_browser_is_ours():
    """Looking along -y with z up: columns are right, down, forwards."""
    axes = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]]).T
    found = valid_camera([0.0, 5.0, 0.0], axes, np.radians(40.0), (200, 100))
    origin, along = found.rays(np.array([50 * 200 + 100]), 0.0)
    np.testing.assert_allclose(origin[0], [0.0, 5.0, 0.0])
    np.testing.assert_allclose(along[0], [0.0, -1.0, 0.0], atol=1e-12)
    _, top = found.rays(np.array([100]), 0.0)
    assert np.degrees(np.arccos(top[0] @ along[0])) == pytest.approx(20.0, abs=1e-9)
    # In a window that is higher than wide the angle from bottom to top is the same.
    tall = valid_camera([0.0, 5.0, 0.0], axes, np.radians(40.0), (100, 200))
    _, top = tall.rays(np.array([50]), 0.0)
    assert np.degrees(np.arccos(top[0] @ along[0])) == pytest.approx(20.0, abs=1e-9)
    with pytest.raises(InputError, match="camera must be finite"):
        valid_camera([0.0, np.nan, 0.0], axes, 1.0, (10, 10))


def test_a_failure_keeps_its_message():
    assert Failure("no").message == "no"
    assert session.FASTER not in (PIXELS, VERTICES)
